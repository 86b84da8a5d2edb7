"""Demonstration: a car to be driven, by a person or a program, among others that do not react."""

from collections.abc import Mapping
from math import atan, pi
from typing import Any

import numpy as np
from gymnasium import spaces
from highway_env.envs.common.action import ContinuousAction
from highway_env.road.road import Road
from jaxtyping import Bool, Float

from ms_highway.envs.merging import changed
from ms_highway.envs.graphics import Viewer
from ms_highway.envs.observations import CarTracks
from ms_highway.envs.routes import DENSITIES, draw_routes
from ms_highway.envs.stage import StageEnv, straight_road
from ms_highway.game.game import Game
from ms_highway.game.scenario import (
    CAR_SIZE,
    COMMON_WEIGHTS,
    LANE_WIDTH,
    PAPER_UNIT,
    SPEED_LIMIT,
    TIME_STEP,
    driving_game,
)
from ms_highway.game.scene import Scene
from ms_highway.vehicle import BicycleVehicle, HumanVehicle, RoutedVehicle, states_of

__all__ = ["KEYBOARD_ACTION", "DemonstrationEnv", "demonstration_game"]

LANES = 3
OTHERS = max(DENSITIES.values())
ABSENT = np.array([-1000.0, 0.0, 0.0, 0.0])  # state of cars that are not there: far behind, where they do not count

LATERAL_SPREAD = 0.5  # m, standard deviation of the start from the middle of a lane
OFF_ROAD_SHARE, OFF_ROAD_DEPTH = 0.2, 1.0  # of episodes start with the car's side up to so many metres off the road
HEADING_SPREAD, SPEED_SPREAD = 0.04, 2.5  # rad and m/s, standard deviations

ACTION = {"type": "ContinuousAction", "acceleration_range": [-50.0, 50.0], "steering_range": [-pi / 4, pi / 4]}
"""Actions that reach all controls within the limits of plans, see `ms_highway.game.scenario.PHYSICAL_LIMIT`."""

KEYBOARD_ACTION = {"type": "ContinuousAction", "acceleration_range": [-6.0, 14.0], "steering_range": [-0.07, 0.07]}
"""Actions to be chosen by arrow keys, which highway-env takes for 0.7 of the range.

Without a key, the engine makes up for the friction at 20 m/s; with one, the car gains or loses 7 m/s^2, or turns at
11 degrees per second.
"""


def demonstration_game(weights: Mapping[str, float] = COMMON_WEIGHTS) -> Game:
    """Build the game of the driver, for weights by name, on three lanes of the paper's scenes."""
    lanes = np.arange(LANES) * LANE_WIDTH * PAPER_UNIT
    scene = Scene(
        lanes=lanes,
        lane_width=LANE_WIDTH * PAPER_UNIT,
        obstacles=np.zeros((0, 2)),
        obstacle_size=np.ones(2),
        car_size=np.array(CAR_SIZE) * PAPER_UNIT,
        corner=0.5,
        target_lane=lanes[0],
        length_unit=PAPER_UNIT,
    )
    return driving_game(scene, SPEED_LIMIT * PAPER_UNIT, weights, grip=None)


class DemonstrationEnv(StageEnv):
    """A car to drive along a road of three lanes, among cars on routes that nothing changes.

    Configuration, beside highway-env's own:

    * ``density``: of the traffic, ``sparse``, ``medium`` or ``dense``, see `ms_highway.envs.routes.DENSITIES`.
    * ``action``: ranges of highway-env's ``ContinuousAction``; `KEYBOARD_ACTION` suits a person.
    * ``duration``: length of an episode [s].

    With highway-env's ``manual_control`` the arrow keys drive, and ``action_type.last_action`` is what they ask for.

    The reward is the driver's after the step, under `ms_highway.game.scenario.COMMON_WEIGHTS`. A collision only costs
    reward: cars neither push each other nor stop, and ``info["collision_effect"]`` says so.

    Attributes:
        game: that the driver plays.
        routes: of the other cars, [others, times, 4]; absent ones stand far behind. They go on beyond the end of the
            episode for as long as a plan looks ahead.
    """

    action_space: spaces.Space | None
    viewer: Viewer | None
    routes: Float[np.ndarray, "others times 4"]

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """highway-env's configuration with this environment's own."""
        return super().default_config() | {
            "observation": {"type": "CarTracks"},
            "action": dict(ACTION),
            "density": "medium",
            "duration": 5.0,
            "simulation_frequency": 10,
            "policy_frequency": 10,
            "screen_width": 960,
            "screen_height": 240,
            "scaling": 10.0,
            "centering_position": [0.35, 0.5],
        }

    def __init__(self, config: dict[str, Any] | None = None, render_mode: str | None = None) -> None:
        self.game = demonstration_game()
        super().__init__(config, render_mode)

    def configure(self, config: dict[str, Any] | None) -> None:
        """Change the configuration, all of it or nothing.

        Raises:
            ValueError: for an unknown key or an impossible value.
        """
        settings = changed(self.config, config)
        for key, only in (("action", "ContinuousAction"), ("observation", "CarTracks")):
            if settings[key]["type"] != only:
                raise ValueError(f"config[{key!r}] has type {settings[key]['type']!r}; here it must be {only!r}")
        self.config = settings
        super().configure(None)

    def update_metadata(self, video_real_time_ratio: int = 1) -> None:
        """Frames per second of a video that plays at true speed."""
        super().update_metadata(video_real_time_ratio)

    def define_spaces(self) -> None:
        """Set observation and action type; an action space that did not change keeps its random generator."""
        before = self.action_space
        self.action_type = ContinuousAction(self, **self.config["action"])
        self.action_space = self.action_type.space()
        if before == self.action_space:
            self.action_space = before
        self.observation_type = CarTracks(self, 1 + OTHERS)
        self.observation_space = self.observation_type.space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds the start and the traffic.
            options: ``"config"``: changes of the configuration.

        Raises:
            ValueError: for unknown options or an impossible configuration.
        """
        unknown = sorted(set(options or {}) - {"config"})
        if unknown:
            raise ValueError(f"unknown reset options {unknown}; the only option is 'config'")
        observation, info = super().reset(seed=seed, options=options)
        if self.config["manual_control"]:
            self.action_type.act(self.action_type.last_action)  # keys that nobody touches also mean something
        return observation, info

    def _reset(self) -> None:
        """Build the road and place the cars."""
        start, steps = self._draw_start(), self.episode_steps + self.game.planner.horizon
        times, lanes = np.arange(steps + 1) * TIME_STEP, np.asarray(self.game.scene.lanes, dtype=float)
        routes = draw_routes(self.np_random, DENSITIES[self.config["density"]], times, lanes, start)
        self.routes = np.tile(ABSENT, (OTHERS, len(times), 1))
        self.routes[: len(routes)] = routes
        self.road = Road(straight_road(self.game), np_random=self.np_random)
        x, y, heading, speed = start.tolist()
        driver = BicycleVehicle(self.road, [x, y], heading, speed)
        driver.color = HumanVehicle.COLOR
        self.road.vehicles = [driver, *(RoutedVehicle(self.road, route) for route in routes)]
        for car in self.road.vehicles:
            car.solid = False  # collisions are seen, without effect
        self.controlled_vehicles = [driver]
        self.collision = False

    def _draw_start(self) -> Float[np.ndarray, "4"]:
        random, scene = self.np_random, self.game.scene
        lanes, half = np.asarray(scene.lanes, dtype=float), float(scene.lane_width) / 2
        y = random.choice(lanes) + random.normal(scale=LATERAL_SPREAD)
        if random.uniform() < OFF_ROAD_SHARE:
            inside = random.uniform(-OFF_ROAD_DEPTH, 0) + BicycleVehicle.WIDTH / 2
            y = random.choice([lanes[0] - half + inside, lanes[-1] + half - inside])
        speed = float(self.game.robot.speed_limit)
        return np.array([0.0, y, random.normal(scale=HEADING_SPREAD), random.normal(speed, SPEED_SPREAD)])

    @property
    def present(self) -> Bool[np.ndarray, "cars"]:
        """Which of the cars are there, the driver first."""
        return np.arange(1 + OTHERS) < len(self.road.vehicles)

    @property
    def car_states(self) -> Float[np.ndarray, "cars 4"]:
        """``(x, y, heading, speed)`` of the driver and of the others in SI units; absent ones stand far behind."""
        states = np.tile(ABSENT, (1 + OTHERS, 1))
        states[: len(self.road.vehicles)] = states_of(self.road.vehicles)
        return states

    def action_for(self, control: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
        """Return the action that executes a control ``(omega, acceleration)``, clipped to what actions reach."""
        omega, acceleration = np.asarray(control, dtype=float).tolist()
        wanted = acceleration, atan(omega * BicycleVehicle.LENGTH)
        ranges = self.action_type.acceleration_range, self.action_type.steering_range
        shares = [np.interp(value, limits, [-1, 1]) for value, limits in zip(wanted, ranges, strict=True)]
        return np.array(shares, dtype=np.float32)

    def render(self) -> np.ndarray | None:
        """Draw the road from above."""
        if self.viewer is None and self.render_mode is not None:
            self.viewer = Viewer(self)
        return super().render()

    def _is_terminated(self) -> bool:
        return False

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:
        """Describe the last step; after a reset, only the driver's speed and what collisions do."""
        info: dict[str, Any] = {"speed": self.vehicle.speed, "collision_effect": "reward only"}
        if self.steps:
            info |= {"action": action, "rewards": self._rewards(action)}
            info |= {"collision": self.collision, "crashed": self.vehicle.hit}
        return info
