"""Define the interface of rules, which choose the model of every human for the coming step; and two simple rules.

`Order` takes the models of a fixed order, `Nearest` predicts the nearest humans by the top of the ladder.

All controls are scaled, see `ms_highway.game.game`. A rung is the place of a model on the rule's ladder.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.choice.situation import nearness
from ms_highway.game.game import Game, pair
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import (
    Array,
    Control,
    Flag,
    Gains,
    HumansControl,
    Index,
    Published,
    Rungs,
    Scalar,
    State,
    naming_writes,
    read_only,
)

PUBLISHED_COSTS = Published({"naive": 0.09, "turn": 0.17, "tom": 0.37})  # s
"""Planning time of each model, as the decisions in the paper's experiments count it."""

SHIPPED_COSTS = {  # s
    "pair": {"naive": 0.0007, "idm": 0.0007, "turn": 0.0013, "tom": 0.0011},
    "physical": {"naive": 0.0007, "idm": 0.0007, "turn": 0.0013, "tom": 0.0011},
    "several": {"naive": 0.0012, "idm": 0.0012, "turn": 0.0018, "tom": 0.0018},
    "physical several": {"naive": 0.0011, "idm": 0.0011, "turn": 0.0014, "tom": 0.0014},
}
"""Planning time of each model by kind of scene, see `shipped_kind`. With several humans, it is the time of a plan in
which the model predicts one of them and naive the others.

These are means over episodes on one core, including the search for a way out: of Merger v1 and Give Way v1 with one
human, and with several of Dense Merge (six episodes) and Dense Merge v1 (20). That search became faster afterwards.
Each mean with several humans is therefore multiplied by a ratio: the time of 12 episodes with the faster search over
their time with the slower one."""

NOT_ESTIMATED = -np.inf
"""Gain of a rung for which none was estimated. It is not NaN, as NaN would trigger ``jax_debug_nans``."""

NEVER = -(2**20)
"""Step that stands for the last check if there was none."""


class Memory(NamedTuple):
    """What a rule remembers.

    Attributes:
        rungs: rung of every human in the plan of the last step; in a `Decision`, for the coming step.
        step: number of the coming step, from 0.
        last_check: for each rung of every human, the step in which Algorithm 1 last checked the rung below it.
    """

    rungs: Rungs
    step: Index
    last_check: Int[Array, "humans rungs"]


class Outcome(NamedTuple):
    """The last step, as a rule sees it. Before the first step, it is a step in which no car moved.

    Attributes:
        before: all cars before the step.
        after: all cars after it.
        robot: scaled control that the robot executed.
        humans: scaled controls of the humans, as observed.
        reward: the robot's reward after the step.
        plan: plan that the robot followed, with the controls that it expected of the humans.
    """

    before: State
    after: State
    robot: Control
    humans: HumansControl
    reward: Scalar
    plan: Plan


class Decision(NamedTuple):
    """What a rule chose.

    Attributes:
        memory: memory with the rungs for the coming step. The caller counts the steps.
        gains: for every human, the estimated gain of each rung over the rung in use, net of the price of its time;
            `NOT_ESTIMATED` where none was estimated. Rules inside a `ms_highway.choice.budget.Budget` return the gain
            over the first rung, without a price.
        failed: whether an estimate that the rule needs could not be computed.
    """

    memory: Memory
    gains: Gains
    failed: Flag


class Rule:
    """Base class of rules, which choose the rungs of the coming step from the outcome of the last one.

    Rules are frozen dataclasses and pytrees with pure methods, so that their numbers may change without recompilation.
    They work for any number of humans, live and in batches.

    Attributes:
        ladder: human models, cheapest first (static).
        estimates: whether a decision needs a computation, which is then compiled and timed.
    """

    ladder: Any
    estimates: ClassVar[bool] = True

    def decide(self, game: Any, memory: Memory, outcome: Any) -> Decision:
        """Choose the rungs of the coming step.

        Args:
            game: game that is played; None in `ms_highway.road`, which plays no game.
            memory: what the rule remembers.
            outcome: outcome of the last step; in `ms_highway.road`, bounds on the gain of each human's response.
        """
        raise NotImplementedError

    def at_price(self, price: Scalar) -> "Rule":
        """Return the rule at another price lambda; a rule without a price is returned unchanged."""
        return replace(self, price=price) if "price" in {each.name for each in fields(self)} else self  # type: ignore

    def deciding_in(self, seconds: Callable[[], float]) -> "Rule":
        """Return the rule with the seconds that a decision takes, if it needs them; ``seconds`` measures them."""
        return self

    def for_unresponsive(self) -> "tuple[Rule, int]":
        """Return the rule, and the rung that predicts unresponsive humans: the first one.

        Raises:
            ValueError: if the first model counts on a response of the human.
        """
        if self.ladder[0].responds:
            message = f"the ladder begins with {self.ladder[0].name}, which counts on a response"
            raise ValueError(f"{message}; with a belief, begin it with a model that does not, such as naive")
        return self, 0

    def check(self) -> None:
        """Check the ladder, and the costs and the price of a rule that has them.

        Raises:
            ValueError: if the ladder holds something else than human models, if the costs or the price are negative,
                or if there is not one cost for each rung; for a rule that estimates, if JAX cannot compile for it.
        """
        if self.estimates:
            compilable(self)
        if strange := [model for model in self.ladder if not isinstance(model, HumanModel)]:
            raise ValueError(f"the ladder has {strange[0]!r}, which is no human model; make one of names with `ladder`")
        costs, price = getattr(self, "costs", None), np.asarray(getattr(self, "price", 0.0))
        if costs is None:
            return
        each = np.asarray(costs.each)
        if each.shape != (len(self.ladder),):
            names = ", ".join(model.name for model in self.ladder)
            raise ValueError(f"costs have the shape {each.shape}; give one for each of {names}")
        if not (price >= 0).all() or (each < 0).any():
            raise ValueError(f"the price is {price} and the costs are {each.tolist()}; neither may be negative")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Order(Rule):
    """Take the rungs from a table: a fixed model, a schedule, a period, or rungs that were drawn beforehand.

    Attributes:
        rungs: rung of every human in each step. Later steps take the last row. A single column holds for all humans.
        ladder: human models (static).
    """

    rungs: Int[Array, "steps humans"]
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    estimates: ClassVar[bool] = False

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Return the rungs of this step; no gain is estimated."""
        xp = memory.last_check.__array_namespace__()  # of NumPy or JAX
        table = xp.asarray(self.rungs)
        row = table[xp.minimum(memory.step, len(table) - 1)]
        return unestimated(memory, xp.broadcast_to(row, memory.rungs.shape))

    def for_unresponsive(self) -> tuple[Rule, int]:
        """Return the order, and the rung of naive, which is added to a ladder without it."""
        names = [model.name for model in self.ladder]
        if Naive.name in names:
            return self, names.index(Naive.name)
        return replace(self, ladder=(*self.ladder, Naive())), len(names)


def always(model: HumanModel) -> Order:
    """Return the rule that predicts every human by the same model in all steps."""
    return Order(np.zeros((1, 1), int), (model,))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nearest(Rule):
    """Predict the nearest humans by the top of the ladder, and all others by the first rung.

    Attributes:
        count: number of humans on the top rung.
        ladder: human models (static).
    """

    count: Index
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Choose by the distances after the last step."""
        rank = nearness(game, outcome.after)
        return unestimated(memory, jnp.where(rank < self.count, len(self.ladder) - 1, 0))


def compilable(rule: Rule) -> Rule:
    """Return a rule of whose class JAX knows the fields.

    Raises:
        ValueError: if JAX does not know them.
    """
    if jax.tree_util.all_leaves([rule]):
        remedy = "write @jax.tree_util.register_dataclass above its @dataclass(frozen=True)"
        raise ValueError(
            f"JAX cannot compile for the rule {type(rule).__name__}, as it does not know its fields; {remedy}"
        )
    return rule


def is_of_package(rule: Rule) -> bool:
    """Return whether a rule is the package's own, whose decisions need no check."""
    return type(rule).__module__.partition(".")[0] == __name__.partition(".")[0]


def decide(rule: Rule, game: Any, memory: Memory, outcome: Any) -> Decision:
    """Choose the rungs of the coming step by a rule, see `Rule.decide`.

    Another rule than the package's gets arrays that it cannot write, and its decision is checked.

    Raises:
        ValueError: if a decision has no whole number for each human; if they are known now, also for numbers that are
            no rungs. Where JAX traces the decision, `refuse_rungs` checks these afterwards.
    """
    if is_of_package(rule):
        return rule.decide(game, memory, outcome)
    name, number = type(rule).__name__, len(memory.rungs)
    with naming_writes(f"the rule {name}"):
        decision = rule.decide(*read_only((game, memory, outcome)))
    if not isinstance(decision, Decision) or not isinstance(decision.memory, Memory):
        remedy = "return a Decision, such as ms_highway.unestimated(memory, rungs)"
        raise ValueError(f"the rule {name} returned {decision!r}; {remedy}")
    rungs = decision.memory.rungs
    rungs = rungs if isinstance(rungs, np.ndarray) else jnp.asarray(rungs)
    traced = isinstance(rungs, jax.core.Tracer)
    if rungs.shape != (number,) or not jnp.isdtype(rungs.dtype, ("bool", "integral")):
        found = f"{rungs.dtype} numbers of shape {rungs.shape}" if traced else f"the rungs {rungs.tolist()}"
        raise ValueError(f"the rule {name} returned {found}; {_rungs_remedy(rule, number)}")
    if jnp.shape(decision.gains) != (number, len(rule.ladder)):
        remedy = f"return one for each human and rung, an array {(number, len(rule.ladder))}"
        raise ValueError(f"the rule {name} returned gains of shape {jnp.shape(decision.gains)}; {remedy}")
    if not traced:
        refuse_rungs(rule, rungs)
    whole = rungs.__array_namespace__().asarray(rungs, dtype=np.int32)
    return decision._replace(memory=decision.memory._replace(rungs=whole))


def in_ladder(rule: Rule, rungs: Any) -> Any:
    """Return where numbers are rungs of the rule's ladder."""
    return (rungs >= 0) & (rungs < len(rule.ladder))


def refuse_rungs(rule: Rule, rungs: Int[Any, "*steps humans"]) -> None:
    """Refuse numbers that a rule chose and that are no rungs of its ladder.

    Raises:
        ValueError: naming the rule and the first such numbers.
    """
    rungs = np.asarray(rungs)
    wrong = ~in_ladder(rule, rungs).all(axis=-1)
    if wrong.any():
        first = rungs[wrong][0] if rungs.ndim > 1 else rungs
        remedy = _rungs_remedy(rule, rungs.shape[-1])
        raise ValueError(f"the rule {type(rule).__name__} returned the rungs {first.tolist()}; {remedy}")


def _rungs_remedy(rule: Rule, humans: int) -> str:
    names = ", ".join(f"{place} for {model.name}" for place, model in enumerate(rule.ladder))
    return f"return one whole number for each human, {humans} in all: {names}"


def with_human(game: Game, outcome: Outcome, human: Index) -> tuple[Game, Outcome]:
    """Return the game of the robot with one human, see `ms_highway.game.game.pair`, and the outcome of this game."""
    if game.number == 1:
        return game, outcome
    alone, before = pair(game, outcome.before, human)
    _, after = pair(game, outcome.after, human)
    plan = Plan(outcome.plan.robot, jnp.asarray(outcome.plan.humans)[human][None])
    return alone, outcome._replace(
        before=before, after=after, humans=jnp.asarray(outcome.humans)[human][None], plan=plan
    )


def shipped_kind(semantics: str, humans: int) -> str:
    """Return the kind of scene for which the package has costs and learned values, a key of `SHIPPED_COSTS`."""
    if humans == 1:
        return "physical" if semantics == "physical" else "pair"
    return "physical several" if semantics == "physical" else "several"


def first_memory(rule: Rule, humans: int) -> Memory:
    """Return the memory before the first step. Every human is on the first rung, and every rung may be checked."""
    checks = np.full((humans, len(rule.ladder)), NEVER, np.int32)
    return Memory(np.zeros(humans, np.int32), np.zeros((), np.int32), checks)


def unestimated(memory: Memory, rungs: Rungs) -> Decision:
    """Return the decision for these rungs, without estimated gains."""
    xp = memory.last_check.__array_namespace__()  # of NumPy or JAX
    gains = xp.full(memory.last_check.shape, NOT_ESTIMATED, dtype=xp.float32)
    if isinstance(rungs, np.ndarray) and rungs.dtype.kind in "iu":  # of 64 bits, which JAX cuts to 32
        rungs = np.clip(rungs, -1, np.iinfo(np.int32).max)
    rungs = xp.asarray(rungs)
    if not xp.isdtype(rungs.dtype, "real floating"):  # which `decide` refuses, instead of cutting its numbers off
        rungs = xp.asarray(rungs, dtype=xp.int32)
    return Decision(memory._replace(rungs=rungs), gains, xp.asarray(False))


def highest_gains(gains: Float[np.ndarray, "*steps humans rungs"]) -> Float[np.ndarray, "*steps rungs"]:
    """Return the highest gain of each rung over all humans, NaN where none was estimated."""
    known = np.isfinite(gains)
    return np.where(known.any(axis=-2), np.where(known, gains, -np.inf).max(axis=-2), np.nan)
