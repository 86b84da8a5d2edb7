"""Hold what a simulation takes and returns: the loop's common numbers, the episodes, and the records of their steps."""

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
from jaxtyping import Bool, Float, Int

from ms_highway.game.game import Game
from ms_highway.metareasoning.rule import Rule
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array
from ms_highway.simulation.devices import CHUNK

__all__ = ["DECIDES", "Episodes", "Loop", "Records"]

DECIDES = -1
"""In a schedule: the rule chooses the rung of this step."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Loop:
    """What all episodes of a simulation share.

    Attributes:
        game: what is played.
        rule: chooses rungs of its ladder; its price is each episode's own.
        others: models that schedules may use beside the ladder; their numbers follow those of its rungs (static).
        chunk: number of episodes computed together (static). A human model is computed only for the chunks that use
            it: smaller chunks waste less computation, larger ones use wide hardware better. The last digits of results
            depend on it, and chaotic episodes (Stay Back) amplify them.
    """

    game: Game
    rule: Rule
    others: tuple[HumanModel, ...] = field(default=(), metadata={"static": True})
    chunk: int = field(default=CHUNK, metadata={"static": True})

    @property
    def models(self) -> tuple[HumanModel, ...]:
        """All models, in the order of their numbers in schedules and records."""
        return (*self.rule.ladder, *self.others)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodes:
    """What is each episode's own.

    Attributes:
        starts: all cars at the start, robot first, then the human.
        prices: lambda, where the rule decides.
        schedules: number of the model that plans each step, or `DECIDES`.
        robot_weights, human_weights: of both rewards, in the order of their features.
    """

    starts: Float[Array, "episodes cars 4"]
    prices: Float[Array, "episodes"]
    schedules: Int[Array, "episodes steps"]
    robot_weights: Float[Array, "episodes features"]
    human_weights: Float[Array, "episodes features"]

    def __len__(self) -> int:
        return len(self.starts)


class Records(NamedTuple):
    """Records of all steps, with the columns of `ms_highway.experiments.runner.episode`.

    Attributes:
        model: number of the model that planned, in `Loop.models`.
        status: of the robot's control, an index of `ms_highway.control.fallback.STATUSES`.
        reward: the robot's, after the step.
        collision: whether the robot collides in it.
        gains: of each rung over the one in use, estimated before the step; NaN where none was.
        states: all cars after the step.
    """

    model: Int[Array, "episodes steps"]
    status: Int[Array, "episodes steps"]
    reward: Float[Array, "episodes steps"]
    collision: Bool[Array, "episodes steps"]
    gains: Float[Array, "episodes steps rungs"]
    states: Float[Array, "episodes steps cars 4"]
