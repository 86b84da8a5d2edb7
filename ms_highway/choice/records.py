"""Define the memory, the evidence and the decisions of rules."""

from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float, Int

from ms_highway.game.game import Game
from ms_highway.game.scenario import Semantics
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import (
    Array,
    Control,
    Flag,
    Gains,
    HumansControl,
    Index,
    PerHuman,
    Rungs,
    Scalar,
    State,
)

NOT_ESTIMATED = -np.inf
"""Gain of a rung for which none was estimated. It is not NaN, as NaN would trigger
``jax_debug_nans``.
"""

NEVER = -(2**20)
"""Step that stands for the last check if there was none. It is so far back that every
cooldown is over.
"""

Cars = TypeVar("Cars")
"""All cars at one moment: a `State` in games, a scene of perception on stock roads."""


class Memory(NamedTuple):
    """Remember the rungs in use, their last checks and their gains.

    Attributes:
        rungs: rung of every human in the plan of the last step; in a `Decision`, for
            the coming step.
        step: index of the coming step, from 0.
        last_check: for the cooldown of `ms_highway.choice.quadratic.Quadratic`, per
            human and rung: number, from 1, of the last step in which the rung was in
            use, the one below was estimated, and the rule did not go up.
        gain: for every human, the gain over the first rung that was estimated for the
            rung in use, when it was last estimated; 0 for the first rung, if there was
            no estimate, and if another rung than the chosen one is used.
    """

    rungs: Rungs
    step: Index
    last_check: Int[Array, "humans rungs"]
    gain: PerHuman


class Outcome(NamedTuple, Generic[Cars]):
    """The last step, as a rule sees it.

    Before the first step, it is a step in which no car moved. On stock roads, humans
    and reward are None.

    Attributes:
        before: all cars before the step.
        after: all cars after it.
        robot: scaled control that the robot executed.
        humans: scaled controls of the humans, as observed.
        reward: the robot's reward in the state after the step.
        plan: plan that the robot followed, with the controls that it expected of the
            humans.
    """

    before: Cars
    after: Cars
    robot: Control
    humans: HumansControl
    reward: Scalar
    plan: Plan


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GameEvidence:
    """What rules see where the robot plays a game.

    Attributes:
        game: game with the humans' rewards as the robot believes them.
        outcome: outcome of the last step.
        ladder: the rule's human models, cheapest first (static).
    """

    game: Game
    outcome: Outcome[State]
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})


class Estimate(NamedTuple):
    """Gain in reward per step of each rung over the first one, before its price.

    Attributes:
        gains: for every human, how much more reward per step each rung earns than the
            first rung, before the price of its time. What it assumes of the rungs of
            the other humans is the estimator's matter: with those of
            `ms_highway.choice.learned_value`, all nearer humans have the same rung. The
            gain of the first rung is 0 where it is estimated. `NOT_ESTIMATED` where
            none is.
        failed: whether a gain that was asked for could not be computed.
    """

    gains: Gains
    failed: Flag


class Decision(NamedTuple):
    """Rungs of the coming step, and the gains by which they were chosen.

    Attributes:
        memory: memory with the rungs for the coming step. Its ``step`` is that of
            before; `ms_highway.loop.step.step` counts.
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
        costs: planning times with these models, NaN where unknown.
        semantics: semantics of the scenario.
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


def highest_gains(
    gains: Float[np.ndarray, "*steps humans rungs"],
) -> Float[np.ndarray, "*steps rungs"]:
    """Return the highest gain of each rung over all humans, NaN where none is known."""
    known = np.isfinite(gains)
    highest = np.where(known, gains, -np.inf).max(axis=-2)
    return np.where(known.any(axis=-2), highest, np.nan)
