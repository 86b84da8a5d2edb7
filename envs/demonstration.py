"""Demonstration: a person or a program drives a car among others that do not react."""

from collections.abc import Mapping
from math import atan, pi
from typing import Literal

import numpy as np
from highway_env.road.road import Road
from msgspec import Struct

from ms_highway.envs.configuration import RANGES, Config
from ms_highway.envs.game_env import GameEnv, straight_road
from ms_highway.game.game import Game
from ms_highway.game.scenario import (
    COMMON_WEIGHTS,
    LANE_WIDTH,
    SPEED_LIMIT,
    TIME_STEP,
    driving_game,
)
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Car, Control, State, Times, Vector
from ms_highway.runtime.limits import Positive
from ms_highway.vehicle import BicycleVehicle, HumanVehicle, RoutedVehicle, states_of

DENSITIES = {"sparse": 2, "medium": 4, "dense": 7}
"""Number of other cars, by name of the density of traffic."""

LANES = 3
OTHERS = max(DENSITIES.values())
ABSENT = np.array(
    [-1000.0, 0.0, 0.0, 0.0]
)  # state of absent cars: so far behind that they do not count

LATERAL_SPREAD = 0.5  # m, standard deviation of the start from the middle of a lane
OFF_ROAD_SHARE, OFF_ROAD_DEPTH = (
    0.2,
    1.0,
)  # share of episodes that start off the road; m, by how much at most
HEADING_SPREAD, SPEED_SPREAD = 0.04, 2.5  # rad and m/s, standard deviations

ACTION = {
    "type": "ContinuousAction",
    "acceleration_range": [-50.0, 50.0],
    "steering_range": [-pi / 4, pi / 4],
}
"""Actions that reach all controls within `ms_highway.game.scenario.PHYSICAL_LIMIT`."""

KEYBOARD_ACTION = {
    "type": "ContinuousAction",
    "acceleration_range": [-6.0, 14.0],
    "steering_range": [-0.07, 0.07],
}
"""Actions for arrow keys; highway-env takes a pressed key for 0.7 of the range.

Without a key, the engine balances the friction at 20 m/s. With one, the car gains or
loses 7 m/s^2, or turns at 11 degrees per second.
"""


def demonstration_game(weights: Mapping[str, float] = COMMON_WEIGHTS) -> Game:
    """Build the game of a driver with these weights by name, on three lanes like those
    of the paper's scenes.
    """
    lanes = np.arange(LANES) * LANE_WIDTH
    scene = Scene(lanes, LANE_WIDTH, target_lane=lanes[0])
    return driving_game(scene, SPEED_LIMIT, weights, grip=None)


class DemonstrationSettings(Struct, frozen=True):
    """The keys of a `DemonstrationEnv` that highway-env does not have."""

    density: Literal["sparse", "medium", "dense"]
    duration: Positive


class DemonstrationEnv(GameEnv):
    """A car to drive on a road of three lanes, among cars whose routes are fixed when
    the episode starts.

    The configuration has highway-env's keys and these; changes act from the next reset
    on:

    * ``density``: of the traffic, ``sparse``, ``medium`` or ``dense``, see
      `ms_highway.envs.demonstration.DENSITIES`.
    * ``action``: ranges of highway-env's ``ContinuousAction``; `KEYBOARD_ACTION` suits
      a person.
    * ``duration``: length of an episode [s].

    With highway-env's ``manual_control`` the arrow keys drive, and
    ``action_type.last_action`` is what they ask for.

    The reward is the driver's after the step, under
    `ms_highway.game.scenario.COMMON_WEIGHTS`. A collision only costs reward: cars
    neither push each other nor stop, and ``info["collision_effect"]`` says so.

    Attributes:
        game: of the driver.
        routes: of the other cars, [others, times, 4]; absent cars stand far behind.
            They extend beyond the end of the episode by the horizon of a plan.
    """

    settings_type = DemonstrationSettings
    types = {  # noqa: RUF012
        "action": {"ContinuousAction": RANGES},
        "observation": {"CarTracks": {}},
    }
    cars = 1 + OTHERS

    @classmethod
    def default_config(cls) -> Config:
        """Return highway-env's default configuration with this environment's keys."""
        return super().default_config() | {
            "observation": {"type": "CarTracks"},
            "action": dict(ACTION),
            "density": "medium",
            "duration": 5.0,
            "screen_width": 960,
            "screen_height": 240,
            "scaling": 10.0,
            "centering_position": [0.35, 0.5],
        }

    def __init__(
        self, config: Config | None = None, render_mode: str | None = None
    ) -> None:
        self.game = demonstration_game()
        super().__init__(config, render_mode)

    def _reset(self) -> None:
        """Build the road and place the cars."""
        start = self._draw_start()
        steps = self.episode_steps + self.game.planner.horizon
        times = np.arange(steps + 1) * TIME_STEP
        lanes = np.asarray(self.game.scene.lanes, dtype=float)
        routes = draw_routes(
            self.np_random, DENSITIES[self.config["density"]], times, lanes, start
        )
        self.routes = np.tile(ABSENT, (OTHERS, len(times), 1))
        self.routes[: len(routes)] = routes
        self.road = Road(straight_road(self.game), np_random=self.np_random)
        driver = BicycleVehicle(self.road, start[:2], *start[2:].tolist())
        driver.color = HumanVehicle.COLOR
        self._place([driver, *(RoutedVehicle(self.road, route) for route in routes)])

    def _draw_start(self) -> Car:
        random = self.np_random
        scene = self.game.scene
        lanes = np.asarray(scene.lanes, dtype=float)
        half = float(scene.lane_width) / 2
        y = random.choice(lanes) + random.normal(scale=LATERAL_SPREAD)
        if random.uniform() < OFF_ROAD_SHARE:
            inside = random.uniform(-OFF_ROAD_DEPTH, 0) + BicycleVehicle.WIDTH / 2
            y = random.choice([lanes[0] - half + inside, lanes[-1] + half - inside])
        speed = float(self.game.robot.speed_limit)
        return np.array(
            [
                0.0,
                y,
                random.normal(scale=HEADING_SPREAD),
                random.normal(speed, SPEED_SPREAD),
            ]
        )

    @property
    def present(self) -> np.ndarray:
        """Which of the cars are there, the driver first."""
        return np.arange(self.cars) < len(self.road.vehicles)

    @property
    def car_states(self) -> State:
        """``(x, y, heading, speed)`` of the driver and of the others in SI units;
        absent ones stand far behind.
        """
        states = np.tile(ABSENT, (self.cars, 1))
        states[: len(self.road.vehicles)] = states_of(self.road.vehicles)
        return states

    def action_for(self, control: Control) -> Control:
        """Return the action that executes a control ``(omega, acceleration)``, clipped
        to what actions reach.
        """
        omega, acceleration = np.asarray(control, dtype=float).tolist()
        wanted = acceleration, atan(omega * BicycleVehicle.LENGTH)
        ranges = self.action_type.acceleration_range, self.action_type.steering_range
        shares = [
            np.interp(value, limits, [-1, 1])
            for value, limits in zip(wanted, ranges, strict=True)
        ]
        return np.array(shares, dtype=np.float32)


NEAR = (-30.0, 60.0)  # m along the road, where routes start
SPEEDS = (18.0, 20.0)  # m/s along the road
LANE_CHANGES = 0.4  # share of the cars that change lane
CHANGE_STARTS, CHANGE_LASTS = (0.0, 2.5), (2.5, 3.5)  # s
GAP, SIDE_GAP = (
    8.0,
    2.8,
)  # m between centres; two cars keep one of them at all times (cars are 5 m x 2.5 m)
TRIES = 200  # for one car, before all are drawn again


def draw_routes(
    random: np.random.Generator,
    cars: int,
    times: Times,
    lanes: Vector,
    driver: Car,
) -> np.ndarray:
    """Draw states ``(x, y, heading, speed)``, [cars, times, 4], of cars that keep clear
    of each other.

    At the start, they also keep clear of the driver. Each car follows its lane at its
    own speed; some change to the adjacent lane along a quintic.

    Args:
        random: source of the draws.
        cars: number of cars.
        times: of the states [s].
        lanes: lateral positions of the lanes' centres, two or more.
        driver: state of the driver at the start; the routes start near it.
    """
    while True:
        routes: list[np.ndarray] = []
        for _ in range(TRIES * cars):
            route = _draw_route(random, times, lanes, driver[0])
            if _clear(route[0], driver) and all(
                _clear(route, other).all() for other in routes
            ):
                routes.append(route)
            if len(routes) == cars:
                return np.array(routes)


def _draw_route(
    random: np.random.Generator, times: Times, lanes: Vector, x: float
) -> np.ndarray:
    lane = random.integers(len(lanes))
    speed = random.uniform(*SPEEDS)
    beside = random.choice(
        [place for place in (lane - 1, lane + 1) if 0 <= place < len(lanes)]
    )
    start = random.uniform(*CHANGE_STARTS)
    lasts = random.uniform(*CHANGE_LASTS)
    width = (lanes[beside] - lanes[lane]) * (random.uniform() < LANE_CHANGES)
    share = np.clip((times - start) / lasts, 0, 1)
    y = lanes[lane] + width * share**3 * (10 - 15 * share + 6 * share**2)
    sideways = width * 30 * (share * (1 - share)) ** 2 / lasts
    along = x + random.uniform(*NEAR) + speed * times
    return np.stack(
        [along, y, np.arctan2(sideways, speed), np.hypot(sideways, speed)], axis=-1
    )


def _clear(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return whether two cars are apart, along the road or across it."""
    apart = np.abs(one[..., :2] - other[..., :2])
    return (apart[..., 0] >= GAP) | (apart[..., 1] >= SIDE_GAP)
