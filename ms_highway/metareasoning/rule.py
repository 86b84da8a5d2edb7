"""Define rules, which choose the human model of the coming step, and what they are told and return.

All controls are scaled, see `ms_highway.game.game`.
"""

from typing import Any, ClassVar, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.game.game import Game
from ms_highway.planning.human_models import HumanModel, JointPlan
from ms_highway.runtime.arrays import Array

__all__ = ["PUBLISHED_COSTS", "Decision", "Memory", "Outcome", "Rule", "check_costs", "decide_by", "first_memory"]

PUBLISHED_COSTS = {"naive": 0.09, "turn": 0.17, "tom": 0.37}  # s
"""Planning time of each model in the decisions of the paper's experiments."""


NEVER = -(2**20)
"""Step of a check that has not been made."""


class Memory(NamedTuple):
    """What a rule remembers: the rung in use, the number of the step, and each rung's last downward check."""

    rung: Int[Array, ""]
    step: Int[Array, ""]
    last_check: Int[Array, "rungs"]


class Outcome(NamedTuple):
    """A step of the world, as a rule sees it.

    Attributes:
        before: all cars before the step.
        after: all cars after it.
        robot: scaled control that the robot executed.
        human: scaled control that the human was observed to execute.
        reward: the robot's, after the step.
        plan: that the robot followed, and the human's controls that it expected.
    """

    before: Float[Array, "cars 4"]
    after: Float[Array, "cars 4"]
    robot: Float[Array, "2"]
    human: Float[Array, "2"]
    reward: Float[Array, ""]
    plan: JointPlan


class Decision(NamedTuple):
    """What a rule chose.

    Attributes:
        memory: with the rung of the coming step.
        gains: estimated gain of each rung over the one in use, NaN where none was estimated.
        failed: whether the rule could not estimate what it needs, and took the top of the ladder.
    """

    memory: Memory
    gains: Float[Array, "rungs"]
    failed: Bool[Array, ""]


class Rule(Protocol):
    """Choose the rung of the coming step from the outcome of the last one.

    Rules are frozen dataclasses and pytrees: numbers may change without compiling anew.

    Attributes:
        ladder: human models, cheapest first.
        costs: T(M), planning time of each rung [s].
        price: lambda, reward per second of planning.
        network: arrays that `choose` needs and `look` does not; None without any.
        chooses_first: whether the rule chooses the rung of the first step, too; where not, that is the cheapest one.
        in_one_kernel: whether `look` may be compiled into one kernel, of which calls of LAPACK cannot be part.
    """

    chooses_first: ClassVar[bool]
    in_one_kernel: ClassVar[bool]
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def ladder(self) -> tuple[HumanModel, ...]:
        """Human models, cheapest first."""

    @property
    def costs(self) -> Float[Array, "rungs"]:
        """Planning time of each rung [s]."""

    @property
    def price(self) -> float | Float[Array, ""]:
        """Reward per second of planning."""

    @property
    def network(self) -> Any:
        """Arrays that only `choose` needs."""

    def look(self, game: Game, memory: Memory, outcome: Outcome) -> Float[jax.Array, "numbers"]:
        """Compute what the choice is based on.

        Before the first step, nothing has happened: the outcome is of a step in which no car moved.
        """

    def choose(self, memory: Memory, seen: Float[jax.Array, "numbers"]) -> Decision:
        """Choose the rung of the coming step by what `look` computed."""


def decide_by(rule: Rule, game: Game, memory: Memory, outcome: Outcome) -> Decision:
    """Look and choose."""
    return rule.choose(memory, rule.look(game, memory, outcome))


def check_costs(rule: Rule) -> None:
    """Check that there is one cost per rung.

    Raises:
        ValueError: if there are fewer or more.
    """
    if np.shape(rule.costs) != (len(rule.ladder),):
        names = ", ".join(model.name for model in rule.ladder)
        raise ValueError(f"costs are of shape {np.shape(rule.costs)}; give one for each of {names}")


def first_memory(rule: Rule, rung: int = 0) -> Memory:
    """Return the memory before the first step; every rung may be checked at once."""
    return Memory(np.asarray(rung, np.int32), np.zeros((), np.int32), np.full(len(rule.ladder), NEVER, np.int32))
