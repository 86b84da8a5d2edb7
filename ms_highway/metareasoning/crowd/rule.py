"""Define rules that choose a rung for each human of a crowd, and what they are told and return.

A rung is a number of `ms_highway.planning.crowd.RUNGS`. All controls are scaled, see `ms_highway.game.game`.
"""

from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.game.crowd import Crowd
from ms_highway.metareasoning.rule import NEVER
from ms_highway.planning.compiled_crowd import CrowdCosts
from ms_highway.planning.crowd import RUNGS, CrowdPlan
from ms_highway.runtime.arrays import Array

__all__ = [
    "CrowdCosts",
    "CrowdDecision",
    "CrowdMemory",
    "CrowdOutcome",
    "CrowdRule",
    "first_crowd_memory",
    "highest_gains",
]


class CrowdMemory(NamedTuple):
    """What a rule remembers.

    Attributes:
        rungs: in use for each human.
        step: its number.
        last_check: of each human's downward check of each rung, see `ms_highway.metareasoning.rule.Memory`.
        seed: of the episode, for rules that draw.
    """

    rungs: Int[Array, "humans"]
    step: Int[Array, ""]
    last_check: Int[Array, "humans rungs"]
    seed: Int[Array, ""]


class CrowdOutcome(NamedTuple):
    """A step of the world, as a rule sees it; before the first step, a step in which no car moved.

    Attributes:
        before, after: all cars before and after the step.
        robot: control that the robot executed.
        humans: controls that the humans were observed to execute.
        reward: the robot's, after the step.
        plan: that the robot followed, and the humans' controls that it expected.
    """

    before: Float[Array, "cars 4"]
    after: Float[Array, "cars 4"]
    robot: Float[Array, "2"]
    humans: Float[Array, "humans 2"]
    reward: Float[Array, ""]
    plan: CrowdPlan


class CrowdDecision(NamedTuple):
    """What a rule chose.

    Attributes:
        memory: with the rungs of the coming step.
        gains: estimated gain of each rung over the cheapest, for each human; NaN where none was estimated. Those of
            Algorithm 1 are over the rung in use, and less the price.
        failed: whether the rule could not estimate what it needs.
    """

    memory: CrowdMemory
    gains: Float[Array, "humans rungs"]
    failed: Bool[Array, ""]


class CrowdRule(Protocol):
    """Choose the rung of every human for the coming step; a frozen dataclass and pytree, pure."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """Choose from the outcome of the last step; before the first step, from the start."""


def highest_gains(gains: Float[np.ndarray, "*steps humans rungs"]) -> Float[np.ndarray, "*steps rungs"]:
    """Return the highest gain of each rung over all humans, NaN where none was estimated."""
    known = np.isfinite(gains)
    return np.where(known.any(axis=-2), np.where(known, gains, -np.inf).max(axis=-2), np.nan)


def first_crowd_memory(humans: int, seed: int = 0) -> CrowdMemory:
    """Return the memory before the first step: every human is predicted naively, and every rung may be checked."""
    return CrowdMemory(
        np.zeros(humans, np.int32),
        np.zeros((), np.int32),
        np.full((humans, len(RUNGS)), NEVER, np.int32),
        np.asarray(seed, np.int32),
    )
