"""What the environments share: road and cones, car 0's reward by feature, and what a step took."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.objects import Obstacle
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.features import features
from ms_highway.game.game import Game
from ms_highway.game.reward import Reward
from ms_highway.game.scenario import CONE_SIZE, PAPER_UNIT
from ms_highway.game.scene import Scene

__all__ = ["Cone", "StageEnv", "Timing", "evaluate", "straight_road"]

ROAD_BEHIND, ROAD_AHEAD = -100.0, 300.0  # m, ends of the drawn road


@jax.jit
def evaluate(scene: Scene, driver: Reward, states: Float[jax.Array, "cars 4"]) -> Float[jax.Array, "2 features"]:
    """Compute the features phi of car 0's state and their terms in its reward, in one transfer."""
    phi = features(scene, driver, states)
    return jnp.stack([phi, phi * driver.weights])


def straight_road(game: Game) -> RoadNetwork:
    """Build highway-env's road network of a game's lanes, with the robot's speed limit."""
    scene = game.scene
    network, lanes = RoadNetwork(), np.asarray(scene.lanes, dtype=float)
    for place, y in enumerate(lanes):
        right = LineType.CONTINUOUS_LINE if place == len(lanes) - 1 else LineType.STRIPED
        apart = place > 0 and y - lanes[place - 1] > 1.01 * float(scene.lane_width)
        left = LineType.CONTINUOUS_LINE if place == 0 else LineType.STRIPED if apart else LineType.NONE
        ends = [ROAD_BEHIND, y], [ROAD_AHEAD, y]
        limit = float(game.robot.speed_limit)
        lane = StraightLane(*ends, width=float(scene.lane_width), line_types=[left, right], speed_limit=limit)
        network.add_lane("start", "end", lane)
    return network


@dataclass(frozen=True)
class Timing:
    """What the robot's step took on this machine. Any two compare equal: measured times are no part of what happened.

    Attributes:
        planning_seconds: wall time of the plan, compilation excluded.
        decision_seconds: wall time of choosing the model, compilation excluded; 0 without a choice.
        compile_seconds: time spent compiling and warming up.
    """

    planning_seconds: float = field(compare=False)
    decision_seconds: float = field(compare=False)
    compile_seconds: float = field(compare=False)


class Cone(Obstacle):
    """A traffic cone."""

    LENGTH, WIDTH = (size * PAPER_UNIT for size in CONE_SIZE)  # m


class StageEnv(AbstractEnv):
    """An environment of a fixed duration, whose reward is that of car 0 after the step, feature by feature.

    Cars are not solid: a collision only costs reward, as in the paper.

    Attributes:
        game: whose reward.
        collision: whether car 0 has collided in the last step.
    """

    config: dict[str, Any]
    metadata: dict[str, Any]
    game: Game

    def __init__(self, config: dict[str, Any] | None = None, render_mode: str | None = None) -> None:
        self.metadata = dict(type(self).metadata)  # highway-env would write the frame rate into the class's own
        self._terms: dict[str, float] = {}
        self.collision = False
        super().__init__(config, render_mode)

    @property
    @abstractmethod
    def car_states(self) -> Float[np.ndarray, "cars 4"]:
        """``(x, y, heading, speed)`` of all cars in SI units."""

    @property
    def episode_steps(self) -> int:
        """Length of an episode that nothing ends early."""
        return round(self.config["duration"] * self.config["policy_frequency"])

    def _simulate(self, action: Any = None) -> None:
        """Let all cars act and move, then evaluate the new state of car 0."""
        for car in self.road.vehicles:
            car.hit = False
        super()._simulate(action)
        states, names = self.car_states.astype(np.float32), self.game.robot.names
        phi, terms = np.asarray(evaluate(self.game.scene, self.game.robot, states)).tolist()
        self._terms = dict(zip(names, terms, strict=True))
        self.collision = bool(phi[names.index("collision")])

    def _reward(self, action: Any) -> float:
        return sum(self._terms.values())

    def _rewards(self, action: Any) -> dict[str, float]:
        return dict(self._terms)

    def _is_truncated(self) -> bool:
        return self.steps >= self.episode_steps
