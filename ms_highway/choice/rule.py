"""Define rules, which choose the model of every human for the coming step.

A rung is the index of a human model on the rule's ladder, from cheap to expensive
models. A `Rule` has two parts. Its `Estimator` says what each rung would gain for each
human over the first rung, before any price. Its `Chooser` takes these gains and what
the rungs cost, and returns rungs. A part may need evidence, a type of its own: in games
the last step, a `GameEvidence`; on stock roads upper bounds on what a better prediction
could gain, see `ms_highway.road.settings`.

`decide` lets a rule choose: estimate, choose, and remember.

All controls are scaled, see `ms_highway.game.game`. What rules take and return is in
`ms_highway.choice.records`.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, Generic, NoReturn, Self, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Int

from ms_highway.choice import checks
from ms_highway.choice.checks import NO_GAINS, RuleNames, are_no_gains
from ms_highway.choice.records import (
    NEVER,
    NOT_ESTIMATED,
    Decision,
    Estimate,
    GameEvidence,
    Memory,
    Outcome,
    Start,
)

# It was defined here before version 3.0, and stays importable.
from ms_highway.choice.shipped import PUBLISHED_COSTS as PUBLISHED_COSTS
from ms_highway.game.game import Game
from ms_highway.planning.costs import UNKNOWN, Costs
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.runtime.arrays import (
    Array,
    Gains,
    RungIndex,
    Rungs,
    Scalar,
    State,
    naming_writes,
    read_only,
)
from ms_highway.runtime.limits import NotNegative

DERIVE = (
    "derive it from ms_highway.Chooser and define `choose`, or from"
    " ms_highway.Estimator and define `estimate`"
)
"""What to derive a rule of one's own from, for messages."""

FROM_START: dict[str, bool] = {"from_start": True}
"""Metadata of a field that only code or `Part.at_start` may set, not configurations."""


# The parts of a rule

Evidence = TypeVar("Evidence", contravariant=True)
"""What a part of a rule sees beside the memory."""


class Part:
    """A part of a rule: a frozen dataclass and a pytree with pure methods.

    Its fields are keys of ``config["controller"]``, except those with the metadata
    `FROM_START`; a field ``price`` is the key ``lambda``. A `msgspec.Meta` in its
    annotation limits a field; the ``description`` there says what to give instead.

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
        """Return the part with what only the start of an episode knows.

        By default, that is the part as it is.
        """
        return self


class Estimator(Part, Generic[Evidence]):
    """Estimate how much more the robot earns if a rung predicts a human.

    This is the gain in reward per step over the first rung, whatever the price. An
    estimator works for any number of humans.
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
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: Evidence,
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
    """Choose a rung for every human by what the rungs gain and cost.

    A rule is a pytree, so that its numbers may change without recompilation. It works
    for any number of humans, live and in batches.

    Attributes:
        ladder: human models, cheapest first (static).
        costs: planning time that a human adds under each rung [s]; NaN where unknown.
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
    def computes(self) -> bool:
        """Whether a decision needs a computation, which is then compiled and timed.

        Rungs that are known beforehand, such as those of an `Order`, need none.
        """
        return self.chooser.computes or self.estimator is not None

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts that it has."""
        if self.estimator is None:
            return (self.chooser,)
        return self.chooser, self.estimator

    @property
    def names(self) -> RuleNames:
        """Names of its parts and models, for messages."""
        estimator = "" if self.estimator is None else type(self.estimator).__name__
        models = tuple(model.name for model in self.ladder)
        return RuleNames(type(self.chooser).__name__, estimator, models)

    def check(self) -> None:
        """Check the ladder, the costs and the price.

        Raises:
            ValueError: if the ladder holds something else than human models, if the
                costs do not name each rung's model exactly once, if they or the price
                are negative, or if the rule computes and JAX does not know the fields
                of a part.
        """
        if self.computes:
            compilable(self)
        checks.check_ladder(self.ladder)
        checks.check_costs(self.costs, self.names.models)
        price = self.chooser.price if isinstance(self.chooser, Priced) else 0.0
        checks.check_not_negative(price, self.costs)


def at_price(rule: Rule[Evidence], price: Scalar) -> Rule[Evidence]:
    """Return the rule at another price lambda; without a price, the rule as it is."""
    if not isinstance(rule.chooser, Priced):
        return rule
    # JAX may trace the price.
    chooser = replace(rule.chooser, price=price)  # type: ignore[arg-type]
    return replace(rule, chooser=chooser)


# Orders of models


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Order(Chooser[object]):
    """Take the rungs from a table.

    The table is a fixed model, a schedule, or rungs that were drawn beforehand.

    Attributes:
        rungs: rung of every human in each step. Later steps take the last row. A single
            column holds for all humans.
    """

    rungs: Int[Array, "steps humans"]
    computes: ClassVar[bool] = False

    def choose(
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: object,
    ) -> Rungs:
        """Return the rungs of this step."""
        xp = memory.last_check.__array_namespace__()  # of NumPy or JAX
        table = xp.asarray(self.rungs)
        last_row = len(table) - 1
        row = table[xp.minimum(memory.step, last_row)]
        return xp.broadcast_to(row, memory.rungs.shape)


def in_order(
    rungs: Int[Array, "steps humans"],
    ladder: tuple[HumanModel, ...],
) -> Rule[object]:
    """Return the rule that takes the rungs of a ladder from a table, see `Order`.

    Its costs are unknown.
    """
    costs = UNKNOWN.select(model.name for model in ladder)
    return Rule(ladder, costs, Order(rungs))


def always(model: HumanModel) -> Rule[object]:
    """Return the rule that predicts every human by the same model in all steps."""
    return in_order(np.zeros((1, 1), int), (model,))


def for_unresponsive(rule: Rule[Evidence]) -> tuple[Rule[Evidence], RungIndex]:
    """Return the rule, and the rung that predicts unresponsive humans.

    It is the first rung; under an order naive, which is added to a ladder without it.

    Raises:
        ValueError: if the first model of a rule that is no order counts on a response
            of the human.
    """
    if isinstance(rule.chooser, Order):
        names = rule.names.models
        if Naive.name in names:
            return rule, RungIndex(names.index(Naive.name))
        longer = in_order(rule.chooser.rungs, (*rule.ladder, Naive()))
        return longer, RungIndex(len(names))

    first = rule.ladder[0]
    if first.responds:
        remedy = "begin it with a model that does not, such as naive"
        raise ValueError(
            f"the ladder begins with {first.name}, which counts on a response; with a"
            f" belief, {remedy}"
        )
    return rule, RungIndex(0)


# Decisions


def decide(
    rule: Rule[GameEvidence],
    game: Game,
    memory: Memory,
    outcome: Outcome[State],
) -> Decision:
    """Choose the rungs of the coming step in a game, see `decide_on`.

    Args:
        rule: rule that chooses.
        game: game with the humans' rewards as the robot believes them.
        memory: what the rule remembers.
        outcome: outcome of the last step.
    """
    return decide_on(rule, memory, GameEvidence(game, outcome, rule.ladder))


def decide_on(rule: Rule[Evidence], memory: Memory, evidence: Evidence) -> Decision:
    """Choose the rungs of the coming step by a rule: estimate, choose, and remember.

    A user's parts get read-only arrays, and their results are checked.

    Raises:
        ValueError: if a user's part returns a wrong shape or type; outside of JAX's
            tracing, also for rungs off the ladder and for gains that are NaN. Where JAX
            traces the decision, `refuse_rungs` checks these afterwards.
    """
    if rule.estimator is None:
        gains = _unknown_gains(memory)
        rungs = _chosen(rule, memory, gains, evidence)
        return unestimated(memory, rungs)

    # Gains first, before any price; then the choice.
    gains, failed = _estimated(rule, rule.estimator, memory, evidence)
    rungs = _chosen(rule, memory, gains, evidence)
    if not is_of_package(rule):
        # Traced code cannot raise: mark these humans for `refuse_rungs`.
        invalid = are_no_gains(gains).any(axis=1)
        rungs = jnp.where(invalid, NO_GAINS, rungs)
    return Decision(_remembered(memory, rungs, gains), gains, jnp.asarray(failed))


def _estimated(
    rule: Rule[Evidence],
    estimator: Estimator[Evidence],
    memory: Memory,
    evidence: Evidence,
) -> Estimate:
    """Return what an estimator says, checked if the estimator is a user's."""
    if checks.is_part_of_package(estimator):
        return estimator.estimate(memory, evidence)
    own_memory, own_evidence = read_only((memory, evidence))
    with naming_writes(f"the estimator {rule.names.estimator}"):
        estimate = estimator.estimate(own_memory, own_evidence)
    return checks.checked_estimate(rule.names, estimate, memory.last_check.shape)


def _chosen(
    rule: Rule[Evidence],
    memory: Memory,
    gains: Gains,
    evidence: Evidence,
) -> Rungs:
    """Return what a chooser says, checked if the chooser is a user's."""
    if checks.is_part_of_package(rule.chooser):
        return rule.chooser.choose(memory, gains, rule.costs, evidence)
    given = read_only((memory, gains, rule.costs, evidence))
    with naming_writes(f"the rule {rule.names.chooser}"):
        rungs = rule.chooser.choose(*given)
    return checks.checked_rungs(rule.names, rungs, len(memory.rungs))


def _remembered(memory: Memory, rungs: Rungs, gains: Gains) -> Memory:
    """Return the memory with new rungs, what was checked, and what the rungs gain."""
    before = jnp.asarray(memory.rungs)
    humans = jnp.arange(len(before))
    ladder = jnp.arange(gains.shape[1])

    # Start the cooldown of Algorithm 1: the rung below counts as checked where it was
    # estimated, unless the rule goes up.
    below = jnp.maximum(before - 1, 0)
    gain_below = gains[humans, below]
    checked = (before > 0) & (gain_below != NOT_ESTIMATED) & (rungs <= before)
    in_use = ladder == before[:, None]  # [humans, rungs]
    is_checked = checked[:, None] & in_use
    last_check = jnp.where(is_checked, memory.step + 1, memory.last_check)

    # Gain of the new rung. Without an estimate, a rung that stays keeps the remembered
    # one.
    top = gains.shape[1] - 1
    estimated = gains[humans, jnp.clip(rungs, 0, top)]
    remembered = jnp.where(rungs == before, memory.gain, 0.0)
    gain = jnp.where(jnp.isfinite(estimated), estimated, remembered)
    gain = gain.astype(jnp.float32)
    return memory._replace(rungs=rungs, last_check=last_check, gain=gain)


def first_memory(rule: Rule[Evidence], humans: int) -> Memory:
    """Return the memory before the first step.

    Every human is on the first rung, and every rung may be checked.
    """
    return Memory(
        rungs=np.zeros(humans, np.int32),
        step=np.zeros((), np.int32),
        last_check=np.full((humans, len(rule.ladder)), NEVER, np.int32),
        gain=np.zeros(humans, np.float32),
    )


def _unknown_gains(memory: Memory) -> Gains:
    """Return gains of all humans and rungs, none of them estimated."""
    xp = memory.last_check.__array_namespace__()  # of NumPy or JAX
    return xp.full(memory.last_check.shape, NOT_ESTIMATED, dtype=xp.float32)


def unestimated(memory: Memory, rungs: Rungs) -> Decision:
    """Return the decision for these rungs, without estimated gains."""
    gains = _unknown_gains(memory)
    xp = memory.last_check.__array_namespace__()  # of NumPy or JAX

    # Whole numbers of 64 bits would be cut to 32, which could make rungs of them.
    if isinstance(rungs, np.ndarray) and rungs.dtype.kind in "iu":
        rungs = np.clip(rungs, -1, np.iinfo(np.int32).max)
    rungs = xp.asarray(rungs)

    # Numbers with a fraction stay as they are: they are refused, not cut off.
    if not xp.isdtype(rungs.dtype, "real floating"):
        rungs = xp.asarray(rungs, dtype=xp.int32)
    return Decision(memory._replace(rungs=rungs), gains, xp.asarray(False))


# Rules of users


def is_of_package(rule: Rule[Evidence]) -> bool:
    """Return whether all parts of a rule are the package's own.

    Their decisions need no check.
    """
    return all(map(checks.is_part_of_package, rule.parts))


def compilable(rule: Rule[Evidence]) -> Rule[Evidence]:
    """Return a rule if JAX knows the fields of its parts.

    Raises:
        ValueError: if it does not.
    """
    for part in rule.parts:
        checks.check_fields(part)
    return rule


def in_ladder(
    rule: Rule[Evidence],
    rungs: Int[Array, "*shape"],
) -> Bool[Array, "*shape"]:
    """Return where numbers are rungs of the rule's ladder."""
    return checks.in_ladder(len(rule.ladder), rungs)


def refuse_rungs(rule: Rule[Evidence], rungs: Int[Array, "*steps humans"]) -> None:
    """Refuse numbers that a rule chose and that are no rungs of its ladder.

    Raises:
        ValueError: naming the rule and the first such numbers, or the estimator whose
            gains were no numbers.
    """
    checks.refuse_rungs(rule.names, rungs)
