"""Define the base of environments that play a game: car 0's reward, and the road."""

from collections.abc import Sequence

import jax
import numpy as np
from gymnasium import spaces
from highway_env.road.lane import LineType, StraightLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

from ms_highway.envs.configuration import Config
from ms_highway.envs.configured import ConfiguredEnv, not_simulated
from ms_highway.envs.info import GameInfo
from ms_highway.game.features import check_user_features, features
from ms_highway.game.game import Game
from ms_highway.game.scene import PAPER_SIZES
from ms_highway.runtime.arrays import State
from ms_highway.runtime.process import refuse_after_fork
from ms_highway.vehicle import states_of

compiled_features = jax.jit(features)


def straight_road(game: Game) -> RoadNetwork:
    """Build the road network of a game's lanes, with the robot's speed limit."""
    network = RoadNetwork()
    lanes = np.asarray(game.scene.lanes, dtype=float)
    width = float(game.scene.lane_width)
    limit = float(game.robot.speed_limit)

    # The ends of the drawn road [m].
    behind = -100.0
    ahead = 300.0
    for y in lanes:
        lines = [
            LineType.CONTINUOUS_LINE if y == edge else LineType.STRIPED
            for edge in (lanes[0], lanes[-1])
        ]
        lane = StraightLane(
            [behind, y], [ahead, y], width=width, line_types=lines, speed_limit=limit
        )
        network.add_lane("start", "end", lane)
    return network


class Cone(Obstacle):
    """A traffic cone."""

    LENGTH, WIDTH = PAPER_SIZES.cone  # m


class GameEnv(ConfiguredEnv):
    """An environment of a fixed duration in which car 0 plays a game.

    The reward is car 0's after the step, feature by feature. Cars are not solid: a
    collision only costs reward, as in the paper, and ``info["collision_effect"]`` says
    so.

    Attributes:
        game: defines car 0's reward.
        collision: whether car 0 has collided in the last step, by the scene's
            ``contact``.
    """

    game: Game

    def _place(self, cars: Sequence[Vehicle]) -> None:
        """Put cars on the road; actions drive the first one."""
        for car in cars:
            car.solid = False  # a collision is noticed, but has no effect
        self.road.vehicles = list(cars)
        self.controlled_vehicles = list(cars[:1])
        self.collision = False
        self._bodies_collide = self.game.scene.bodies_collide
        self._terms = dict.fromkeys(self.game.robot.names, 0.0)

    @property
    @not_simulated
    def car_states(self) -> State:
        """``(x, y, heading, speed)`` of all cars in SI units, the driven one first."""
        return states_of(self.road.vehicles)

    @property
    @not_simulated
    def episode_steps(self) -> int:
        """Number of steps of an episode that nothing ends early."""
        return round(self.config["duration"] * self.config["policy_frequency"])

    def _simulate(self, action: object = None) -> None:
        """Let all cars act and move, then evaluate the new state of car 0."""
        refuse_after_fork()
        for car in self.road.vehicles:
            car.hit = False
        super()._simulate(action)
        robot = self.game.robot
        states = self.car_states
        scene = self.game.scene
        phi = np.asarray(compiled_features(scene, robot, states.astype(np.float32)))
        if robot.user_features and not np.isfinite(phi).all():
            check_user_features(scene, robot, 0, states, gradients=False)
        terms = (phi * np.asarray(robot.weights)).tolist()
        self._terms = dict(zip(robot.names, terms, strict=True))
        self.collision = bool(phi[robot.names.index("collision")])

    @not_simulated
    def _reward(self, action: object) -> float:
        return sum(self._terms.values())

    @not_simulated
    def _rewards(self, action: object) -> dict[str, float]:
        return dict(self._terms)

    @not_simulated
    def _is_truncated(self) -> bool:
        return self.steps >= self.episode_steps

    @not_simulated
    def _is_terminated(self) -> bool:
        return bool(self.config.get("terminate_on_collision") and self.collision)

    def _info(self, obs: object, action: object = None) -> Config:
        """Describe the last step; after a reset, the reward and its terms are 0."""
        # The paper's indicator misses overlaps of bodies that highway-env notices.
        crashed = self.collision if self._bodies_collide else bool(self.vehicle.hit)

        info: GameInfo = {
            "speed": float(self.vehicle.speed),
            "collision_effect": "reward only",
            "collision": self.collision,
            "crashed": crashed,
            "control": {
                name: float(value) for name, value in self.vehicle.action.items()
            },
            "action": self._given_action(action),
            "rewards": self._rewards(action),
        }
        return dict(info)

    def _given_action(self, action: object) -> object:
        """Return a copy of an action with the type of those in the action space.

        It is NaN or -1 where none is given.
        """
        # highway-env draws one for a reset.
        given = action if self.steps else None
        space = self.action_space
        if isinstance(space, spaces.Tuple):
            return given
        if given is None:
            missing = np.nan if isinstance(space, spaces.Box) else -1
            given = np.full(space.shape or (), missing)
        return np.array(given, space.dtype)[()]
