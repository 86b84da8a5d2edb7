"""Define rules, which choose the model of every human for the coming step.

A `Rule` has two parts. Its `Estimator` says what each rung of the ladder would gain for
each human over the first rung, before any price. Its `Chooser` takes these gains and
what the rungs cost, and returns rungs. A part may need evidence, a type of its own: in
games the last step, a `GameEvidence`; on stock roads the bounds of proposals, see
`ms_highway.road.settings`.

All controls are scaled, see `ms_highway.game.game`. A rung is the place of a model on
the rule's ladder.
"""

import reprlib
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, NamedTuple, NoReturn, Self, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.game import Game
from ms_highway.game.scenario import Semantics
from ms_highway.planning.costs import UNKNOWN, Costs
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import (
    Array,
    Control,
    Flag,
    Gains,
    HumansControl,
    Index,
    PerHuman,
    Published,
    Rungs,
    Scalar,
    naming_writes,
    read_only,
)
from ms_highway.runtime.limits import NotNegative

PUBLISHED_COSTS = Published({"naive": 0.09, "turn": 0.17, "tom": 0.37})  # s
"""Planning time of each model, as the decisions in the paper's experiments count it."""

SHIPPED_COSTS = {  # s
    "pair": {"naive": 0.0007, "idm": 0.0007, "turn": 0.0013, "tom": 0.0011},
    "physical": {"naive": 0.0007, "idm": 0.0007, "turn": 0.0013, "tom": 0.0011},
    "several": {"naive": 0.0012, "idm": 0.0012, "turn": 0.0018, "tom": 0.0018},
    "physical several": {"naive": 0.0011, "idm": 0.0011, "turn": 0.0014, "tom": 0.0014},
}
"""Planning time of each model by kind of scene, see `shipped_kind`. With several
humans, it is the time of a plan in which the model predicts one of them and naive the
others.

These are means over episodes on one core, including the search for a way out: of Merger
v1 and Give Way v1 with one human, and with several of Dense Merge (six episodes) and
Dense Merge v1 (20). That search became faster afterwards. Each mean with several humans
is therefore multiplied by a ratio: the time of 12 episodes with the faster search over
their time with the slower one.
"""

NOT_ESTIMATED = -np.inf
"""Gain of a rung for which none was estimated. It is not NaN, as NaN would trigger
``jax_debug_nans``.
"""

NEVER = -(2**20)
"""Step that stands for the last check if there was none."""

NO_GAINS = int(np.iinfo(np.int32).min)
"""Rung that stands for gains that are no numbers. JAX cannot raise an error where it
traces a decision, so that `refuse_rungs` raises it afterwards.
"""

REAL = ("bool", "integral", "real floating")
"""Types of numbers that gains may be, as `jax.numpy.isdtype` names them."""

DERIVE = (
    "derive it from ms_highway.Chooser and define `choose`, or from"
    " ms_highway.Estimator and define `estimate`"
)
"""What to derive a rule of one's own from."""

FROM_START: dict[str, bool] = {"from_start": True}
"""Metadata of a field that configurations cannot set: code or the start of an episode
does, see `Part.at_start`."""


# Inputs and results of rules


class Memory(NamedTuple):
    """What a rule remembers: the rungs in use, when they were checked, what they gain.

    Attributes:
        rungs: rung of every human in the plan of the last step; in a `Decision`, for
            the coming step.
        step: number of the coming step, from 0.
        last_check: per human and rung: the last step in which, with this rung in use,
            the rung below was estimated and the rule did not go up.
        gain: for every human, the gain over the first rung that was estimated for the
            rung in use, when it was last estimated; 0 for the first rung, and if there
            was no estimate.
    """

    rungs: Rungs
    step: Index
    last_check: Int[Array, "humans rungs"]
    gain: PerHuman


class Outcome(NamedTuple):
    """The last step, as a rule sees it. Before the first step, it is a step in which no
    car moved.

    Attributes:
        before: all cars before the step; on a stock road, the scene.
        after: all cars after it, likewise.
        robot: scaled control that the robot executed.
        humans: scaled controls of the humans, as observed.
        reward: the robot's reward after the step.
        plan: plan that the robot followed, with the controls that it expected of the
            humans.
    """

    before: Any
    after: Any
    robot: Control
    humans: HumansControl
    reward: Scalar
    plan: Plan


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GameEvidence:
    """What rules see where the robot plays a game.

    Attributes:
        game: with the humans' rewards as the robot believes them.
        outcome: of the last step.
        ladder: the rule's human models, cheapest first (static).
    """

    game: Game
    outcome: Outcome
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})


class Estimate(NamedTuple):
    """Gain in reward per step of each rung over the first one, before its price.

    Attributes:
        gains: for every human, how much more reward per step each rung earns than the
            first rung, before the price of its time. The gain of the first rung is 0
            where it is estimated. `NOT_ESTIMATED` where none is.
        failed: whether a gain that was asked for could not be computed.
    """

    gains: Gains
    failed: Flag


class Decision(NamedTuple):
    """Rungs of the coming step, and the gains by which they were chosen.

    Attributes:
        memory: memory with the rungs for the coming step. The caller counts the steps.
        gains: see `Estimate`; `NOT_ESTIMATED` for all rungs of a rule without an
            estimator.
        failed: see `Estimate`.
    """

    memory: Memory
    gains: Gains
    failed: Flag


class Start(NamedTuple):
    """What is known when an episode starts.

    Attributes:
        ladder: human models to choose from, cheapest first.
        costs: of plans with them, NaN where unknown.
        semantics: of the scenario.
        humans: number of humans.
        steps: number of steps of the episode.
        random: source of the draws.
    """

    ladder: tuple[HumanModel, ...]
    costs: Costs
    semantics: Semantics
    humans: int
    steps: int
    random: np.random.Generator


# The parts of a rule

Evidence = TypeVar("Evidence", contravariant=True)
"""What a part of a rule sees beside the memory."""


class Part:
    """A part of a rule: a frozen dataclass and a pytree with pure methods.

    Its fields are keys of ``config["controller"]``, except those with the metadata
    `FROM_START`; a field ``price`` is the key ``lambda``. Annotations with a
    `msgspec.Meta` limit them, and its ``description`` says what to give instead.

    Attributes:
        tag: name in configurations and commands, given as ``class Near(Chooser,
            tag="near")``, see `ms_highway.add_rule`.
    """

    tag: ClassVar[str] = ""

    def __init_subclass__(cls, tag: str = "") -> None:
        """Note the name."""
        super().__init_subclass__()
        cls.tag = tag

    def at_start(self, start: Start) -> Self:
        """Return the part with what only the start of an episode knows; by default, as
        it is.
        """
        return self


class Estimator(Part, Generic[Evidence]):
    """Say what each rung would gain for each human, whatever its price, for any number
    of humans.
    """

    def estimate(self, memory: Memory, evidence: Evidence) -> Estimate:
        """Estimate the gains of all rungs over the first one.

        Args:
            memory: what the rule remembers; its ``last_check`` has the shape [humans,
                rungs].
            evidence: what happened.
        """
        raise NotImplementedError


class Chooser(Part, Generic[Evidence]):
    """Choose rungs by their gains and costs, for any number of humans.

    Attributes:
        computes: whether a choice needs a computation, which is then compiled and
            timed.
    """

    computes: ClassVar[bool] = True

    def choose(
        self, memory: Memory, gains: Gains, costs: Costs, evidence: Evidence
    ) -> Rungs:
        """Return the rung of every human in the coming step.

        Args:
            memory: what the rule remembers; its rungs are those in use.
            gains: of the rule's estimator, see `Estimate`.
            costs: of plans [s].
            evidence: what happened.
        """
        raise NotImplementedError


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Priced(Chooser[Evidence]):
    """Base of choosers at a price, by which batches of episodes may differ.

    Attributes:
        price: lambda, reward per second of planning.
    """

    price: NotNegative


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rule(Generic[Evidence]):
    """Choose a rung for every human: estimate the gains, then weigh them against the
    costs.

    A rule is a pytree, so that its numbers may change without recompilation. It works
    for any number of humans, live and in batches.

    Attributes:
        ladder: human models, cheapest first (static).
        costs: planning time of each rung [s]; NaN where unknown.
        chooser: chooses the rungs.
        estimator: says what they gain; None if the chooser needs no gains.
    """

    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    costs: Costs
    chooser: Chooser[Evidence]
    estimator: Estimator[Evidence] | None = None

    def __init_subclass__(cls) -> NoReturn:
        """Refuse rules that are classes, as before version 3.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"the rule {cls.__name__} derives from Rule; {DERIVE}")

    @property
    def estimates(self) -> bool:
        """Whether a decision needs a computation, which is then compiled and timed."""
        return self.chooser.computes or self.estimator is not None

    @property
    def name(self) -> str:
        """Name of what chooses, for messages."""
        return type(self.chooser).__name__

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts that it has."""
        return (
            (self.chooser,)
            if self.estimator is None
            else (self.chooser, self.estimator)
        )

    def check(self) -> None:
        """Check the ladder, the costs and the price.

        Raises:
            ValueError: if the ladder holds something else than human models, if the
                costs are not one for each rung by the names of their models, or if they
                or the price are negative; if JAX cannot compile a decision that needs
                it.
        """
        if self.estimates:
            compilable(self)

        # The ladder.
        if strange := [
            model for model in self.ladder if not isinstance(model, HumanModel)
        ]:
            raise ValueError(
                f"the ladder has {strange[0]!r}, which is no human model; make one of"
                " names with `ladder`"
            )
        names = tuple(model.name for model in self.ladder)

        # One cost for each of its rungs.
        if not isinstance(self.costs, Costs):
            remedy = "make them of seconds by name with ms_highway.Costs.of"
            raise ValueError(f"the costs are {shown(self.costs)}; {remedy}")
        each = np.asarray(self.costs.each)
        known = self.costs.names
        if known != names or each.shape != (len(names),):
            message = (
                f"the costs are {each.tolist()} for {', '.join(known) or 'no model'}"
            )
            remedy = "in this order, as costs.select(names) does"
            raise ValueError(
                f"{message}; give one for each of {', '.join(names)}, {remedy}"
            )

        # Neither negative costs nor a negative price.
        price = np.asarray(
            self.chooser.price if isinstance(self.chooser, Priced) else 0.0
        )
        if not (price >= 0).all() or (each < 0).any():
            raise ValueError(
                f"the price is {price} and the costs are {each.tolist()}; neither may"
                " be negative"
            )


def at_price(rule: Rule[Evidence], price: Scalar) -> Rule[Evidence]:
    """Return the rule at another price lambda; a rule without a price is returned
    unchanged.
    """
    if not isinstance(rule.chooser, Priced):
        return rule
    chooser = replace(rule.chooser, price=price)  # type: ignore[arg-type] # JAX may trace it
    return replace(rule, chooser=chooser)


# Orders of models


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Order(Chooser[object]):
    """Take the rungs from a table: a fixed model, a schedule, or rungs that were drawn
    beforehand.

    Attributes:
        rungs: rung of every human in each step. Later steps take the last row. A single
            column holds for all humans.
    """

    rungs: Int[Array, "steps humans"]
    computes: ClassVar[bool] = False

    def choose(
        self, memory: Memory, gains: Gains, costs: Costs, evidence: object
    ) -> Rungs:
        """Return the rungs of this step."""
        xp = memory.last_check.__array_namespace__()  # of NumPy or JAX
        table = xp.asarray(self.rungs)
        row = table[xp.minimum(memory.step, len(table) - 1)]
        return xp.broadcast_to(row, memory.rungs.shape)


def in_order(
    rungs: Int[Array, "steps humans"], ladder: tuple[HumanModel, ...]
) -> Rule[Any]:
    """Return the rule that takes the rungs of a ladder from a table, see `Order`; its
    costs are unknown.
    """
    costs = UNKNOWN.select(model.name for model in ladder)
    return Rule(ladder, costs, Order(rungs))


def always(model: HumanModel) -> Rule[Any]:
    """Return the rule that predicts every human by the same model in all steps."""
    return in_order(np.zeros((1, 1), int), (model,))


def for_unresponsive(rule: Rule[Evidence]) -> tuple[Rule[Evidence], int]:
    """Return the rule, and the rung that predicts unresponsive humans.

    It is the first rung; under an order naive, which is added to a ladder without it.

    Raises:
        ValueError: if the first model of a rule that is no order counts on a response
            of the human.
    """
    first = rule.ladder[0]
    if isinstance(rule.chooser, Order):
        names = [model.name for model in rule.ladder]
        if Naive.name in names:
            return rule, names.index(Naive.name)
        return in_order(rule.chooser.rungs, (*rule.ladder, Naive())), len(names)
    if first.responds:
        message = f"the ladder begins with {first.name}, which counts on a response"
        raise ValueError(
            f"{message}; with a belief, begin it with a model that does not, such as"
            " naive"
        )
    return rule, 0


# Decisions


def decide(
    rule: Rule[GameEvidence], game: Game, memory: Memory, outcome: Outcome
) -> Decision:
    """Choose the rungs of the coming step in a game, see `decide_on`.

    Args:
        rule: that chooses.
        game: with the humans' rewards as the robot believes them.
        memory: what the rule remembers.
        outcome: of the last step.
    """
    return decide_on(rule, memory, GameEvidence(game, outcome, rule.ladder))


def decide_on(rule: Rule[Evidence], memory: Memory, evidence: Evidence) -> Decision:
    """Choose the rungs of the coming step by a rule: estimate, choose, and remember.

    A user's parts get read-only arrays, and their results are checked.

    Raises:
        ValueError: if a part returns arrays of a wrong shape or type; if they are known
            now, also for numbers that are no rungs, and for gains that are no numbers.
            Where JAX traces the decision, `refuse_rungs` checks these afterwards.
    """
    shape = memory.last_check.shape
    if rule.estimator is None:
        xp = memory.last_check.__array_namespace__()  # of NumPy or JAX
        gains = xp.full(shape, NOT_ESTIMATED, dtype=xp.float32)
        rungs = _chosen(rule, memory, gains, evidence)
        return unestimated(memory, rungs)

    # Gains first, before any price; then the choice.
    gains, failed = _estimated(rule, rule.estimator, memory, evidence)
    rungs = _chosen(rule, memory, gains, evidence)
    if not is_of_package(rule):
        unknown = _no_gains(gains).any(axis=1)
        rungs = jnp.where(unknown, NO_GAINS, rungs)
    return Decision(_remembered(memory, rungs, gains), gains, jnp.asarray(failed))


def _estimated(
    rule: Rule[Evidence],
    estimator: Estimator[Evidence],
    memory: Memory,
    evidence: Evidence,
) -> Estimate:
    """Return what an estimator says; check it, if the estimator is not the package's."""
    if _is_own(estimator):
        return estimator.estimate(memory, evidence)
    name = type(estimator).__name__
    with naming_writes(f"the estimator {name}"):
        estimate = estimator.estimate(*read_only((memory, evidence)))
    if not isinstance(estimate, Estimate):
        remedy = "return an Estimate(gains, failed)"
        raise ValueError(f"the estimator {name} returned {shown(estimate)}; {remedy}")

    # Gains: one real number for each human and rung.
    shape = memory.last_check.shape
    remedy = f"return one for each human and rung, an array {shape}"
    gains = _as_numbers(estimate.gains)
    if gains is None or not jnp.isdtype(gains.dtype, REAL):
        found = shown(estimate.gains)
        raise ValueError(f"the estimator {name} returned the gains {found}; {remedy}")
    if gains.shape != shape:
        message = f"the estimator {name} returned gains of shape {gains.shape}"
        raise ValueError(f"{message}; {remedy}")
    gains = jnp.asarray(gains, jnp.float32)
    if not isinstance(gains, jax.core.Tracer) and _no_gains(gains).any():
        raise ValueError(_gains_message(rule))

    # Whether they failed: one flag.
    failed = _as_numbers(estimate.failed)
    if failed is None or failed.shape != () or failed.dtype != bool:
        found = shown(estimate.failed)
        remedy = "return one boolean for all humans, such as flags.any()"
        raise ValueError(f"the estimator {name} returned failed={found}; {remedy}")
    return Estimate(gains, failed)


def _chosen(
    rule: Rule[Evidence], memory: Memory, gains: Gains, evidence: Evidence
) -> Rungs:
    """Return the rungs that a chooser returns; check them, if the chooser is not the
    package's.
    """
    if _is_own(rule.chooser):
        return rule.chooser.choose(memory, gains, rule.costs, evidence)
    name = rule.name
    number = len(memory.rungs)
    with naming_writes(f"the rule {name}"):
        returned = rule.chooser.choose(
            *read_only((memory, gains, rule.costs, evidence))
        )

    # One whole number for each human.
    remedy = _rungs_remedy(rule, number)
    rungs = _as_numbers(returned)
    if rungs is None:
        raise ValueError(f"the rule {name} returned {shown(returned)}; {remedy}")
    traced = isinstance(rungs, jax.core.Tracer)
    if rungs.shape != (number,) or not jnp.isdtype(rungs.dtype, ("bool", "integral")):
        found = (
            f"{rungs.dtype} numbers of shape {rungs.shape}"
            if traced
            else f"the rungs {rungs.tolist()}"
        )
        raise ValueError(f"the rule {name} returned {found}; {remedy}")

    # Of the ladder.
    if not traced:
        refuse_rungs(rule, rungs)
    return rungs.__array_namespace__().asarray(rungs, dtype=np.int32)


def _as_numbers(returned: Any) -> Any:
    """Return what a part returned as an array of NumPy or JAX; None if it holds no
    numbers.
    """
    if isinstance(returned, np.ndarray):
        return returned if returned.dtype.kind in "biufc" else None
    try:
        return jnp.asarray(returned)
    except (TypeError, ValueError, OverflowError):
        return None


def shown(returned: Any) -> str:
    """Return what a part returned, in short and on one line, for messages."""
    if isinstance(returned, jax.core.Tracer):
        return f"{returned.dtype} numbers of shape {returned.shape}"
    return " ".join(reprlib.repr(returned).split())


def _no_gains(gains: Gains) -> Any:
    """Return where gains are neither numbers nor `NOT_ESTIMATED`."""
    return ~jnp.isfinite(gains) & (gains != NOT_ESTIMATED)


def _remembered(memory: Memory, rungs: Rungs, gains: Gains) -> Memory:
    """Return the memory with new rungs, with what was checked, and with the gain of the
    rung that is now in use.
    """
    before = jnp.asarray(memory.rungs)
    humans = jnp.arange(len(before))
    places = jnp.arange(gains.shape[1])

    # The rung below counts as checked where it was estimated, unless the rule goes up.
    below = gains[humans, jnp.maximum(before - 1, 0)]
    checked = (before > 0) & (below != NOT_ESTIMATED) & (rungs <= before)
    in_use = places == before[:, None]
    last_check = jnp.where(
        checked[:, None] & in_use, memory.step + 1, memory.last_check
    )

    # Gain of the new rung. Without an estimate, a rung that stays keeps the remembered
    # one.
    gain = gains[humans, jnp.clip(rungs, 0, gains.shape[1] - 1)]
    known = jnp.where(rungs == before, memory.gain, 0.0)
    gain = jnp.where(jnp.isfinite(gain), gain, known).astype(jnp.float32)
    return memory._replace(rungs=rungs, last_check=last_check, gain=gain)


def first_memory(rule: Rule[Any], humans: int) -> Memory:
    """Return the memory before the first step. Every human is on the first rung, and
    every rung may be checked.
    """
    checks = np.full((humans, len(rule.ladder)), NEVER, np.int32)
    return Memory(
        np.zeros(humans, np.int32),
        np.zeros((), np.int32),
        checks,
        np.zeros(humans, np.float32),
    )


def unestimated(memory: Memory, rungs: Rungs) -> Decision:
    """Return the decision for these rungs, without estimated gains."""
    xp = memory.last_check.__array_namespace__()  # of NumPy or JAX
    gains = xp.full(memory.last_check.shape, NOT_ESTIMATED, dtype=xp.float32)
    if (
        isinstance(rungs, np.ndarray) and rungs.dtype.kind in "iu"
    ):  # of 64 bits, which JAX cuts to 32
        rungs = np.clip(rungs, -1, np.iinfo(np.int32).max)
    rungs = xp.asarray(rungs)
    if not xp.isdtype(
        rungs.dtype, "real floating"
    ):  # which is refused, instead of cutting its numbers off
        rungs = xp.asarray(rungs, dtype=xp.int32)
    return Decision(memory._replace(rungs=rungs), gains, xp.asarray(False))


# Rules of a user's


def _is_own(part: Part) -> bool:
    """Return whether a part is the package's own."""
    return type(part).__module__.partition(".")[0] == __name__.partition(".")[0]


def is_of_package(rule: Rule[Any]) -> bool:
    """Return whether all parts of a rule are the package's own, whose decisions need no
    check.
    """
    return all(map(_is_own, rule.parts))


def compilable(rule: Rule[Evidence]) -> Rule[Evidence]:
    """Return a rule of whose parts JAX knows the fields.

    Raises:
        ValueError: if JAX does not know them.
    """
    for part in rule.parts:
        if jax.tree_util.all_leaves([part]):
            remedy = (
                "write @jax.tree_util.register_dataclass above its"
                " @dataclass(frozen=True)"
            )
            raise ValueError(
                f"JAX cannot compile for the rule {type(part).__name__}, as it does not"
                f" know its fields; {remedy}"
            )
    return rule


def in_ladder(rule: Rule[Any], rungs: Any) -> Any:
    """Return where numbers are rungs of the rule's ladder."""
    return (rungs >= 0) & (rungs < len(rule.ladder))


def refuse_rungs(rule: Rule[Any], rungs: Int[Any, "*steps humans"]) -> None:
    """Refuse numbers that a rule chose and that are no rungs of its ladder.

    Raises:
        ValueError: naming the rule and the first such numbers, or the estimator whose
            gains were no numbers.
    """
    rungs = np.asarray(rungs)
    if (rungs == NO_GAINS).any():
        raise ValueError(_gains_message(rule))
    wrong = ~in_ladder(rule, rungs).all(axis=-1)
    if wrong.any():
        first = rungs[wrong][0] if rungs.ndim > 1 else rungs
        remedy = _rungs_remedy(rule, rungs.shape[-1])
        raise ValueError(
            f"the rule {rule.name} returned the rungs {first.tolist()}; {remedy}"
        )


def _rungs_remedy(rule: Rule[Any], humans: int) -> str:
    names = ", ".join(
        f"{place} for {model.name}" for place, model in enumerate(rule.ladder)
    )
    return f"return one whole number for each human, {humans} in all: {names}"


def _gains_message(rule: Rule[Any]) -> str:
    remedy = "return -inf (NOT_ESTIMATED) where no gain is known"
    return (
        f"the estimator {type(rule.estimator).__name__} returned gains that are NaN or"
        f" infinite; {remedy}"
    )


def shipped_kind(semantics: str, humans: int) -> str:
    """Return the kind of scene for which the package has costs and learned values, a
    key of `SHIPPED_COSTS`.
    """
    if humans == 1:
        return "physical" if semantics == "physical" else "pair"
    return "physical several" if semantics == "physical" else "several"


def highest_gains(
    gains: Float[np.ndarray, "*steps humans rungs"],
) -> Float[np.ndarray, "*steps rungs"]:
    """Return the highest gain of each rung over all humans, NaN where none was
    estimated.
    """
    known = np.isfinite(gains)
    return np.where(
        known.any(axis=-2), np.where(known, gains, -np.inf).max(axis=-2), np.nan
    )
