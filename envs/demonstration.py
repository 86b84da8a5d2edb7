"""Demonstration: a person or a program drives a car among others that do not react."""

from collections.abc import Mapping
from dataclasses import dataclass
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
    SPEED_LIMIT,
    TIME_STEP,
    driving_game,
)
from ms_highway.game.scene import PAPER_SIZES, Scene
from ms_highway.runtime.arrays import Car, Control, State, Times, Vector
from ms_highway.runtime.limits import Positive
from ms_highway.vehicle import BicycleVehicle, HumanVehicle, RoutedVehicle, states_of

DENSITIES = {"sparse": 2, "medium": 4, "dense": 7}
"""Number of other cars, by name of the density of traffic."""

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


@dataclass(frozen=True)
class DriverStart:
    """Set how the start of the driver is drawn, so that it has something to correct."""

    lateral_spread: float = 0.5
    """Standard deviation from the middle of a lane [m]."""
    heading_spread: float = 0.04
    """Standard deviation of the heading [rad]."""
    speed_spread: float = 2.5
    """Standard deviation from the speed limit [m/s]."""
    off_road_share: float = 0.2
    """Share of episodes that start off the road, so that driving back is shown, too."""
    off_road_depth: float = 1.0
    """Depth off the road at most [m]."""


@dataclass(frozen=True)
class RouteDraw:
    """Set how the routes of the other cars are drawn."""

    places: tuple[float, float] = (-30.0, 60.0)
    """Places along the road where routes start, from the driver [m]."""
    speeds: tuple[float, float] = (18.0, 20.0)
    """Speeds along the road [m/s]."""
    lane_change_share: float = 0.4
    """Share of the cars that change lane."""
    change_starts: tuple[float, float] = (0.0, 2.5)
    """Times at which lane changes start [s]."""
    change_durations: tuple[float, float] = (2.5, 3.5)
    """Durations of lane changes [s]."""
    gap: float = 8.0
    """Distance of centres along the road at which two cars are apart [m]; cars are 5 m
    long.
    """
    side_gap: float = 2.8
    """Distance of centres across the road at which two cars are apart [m]; cars are
    2.5 m wide.
    """
    tries: int = 200
    """Routes that are drawn for one car, on average, before all are drawn again."""


DRIVER_START = DriverStart()
ROUTE_DRAW = RouteDraw()


def demonstration_game(weights: Mapping[str, float] = COMMON_WEIGHTS) -> Game:
    """Build the game of a driver with these weights by name.

    Its three lanes are like those of the paper's scenes.
    """
    lanes = np.arange(3) * PAPER_SIZES.lane_width
    scene = Scene(lanes, PAPER_SIZES.lane_width, target_lane=lanes[0])
    return driving_game(scene, SPEED_LIMIT, weights, grip=None)


class DemonstrationSettings(Struct, frozen=True):
    """The keys of a `DemonstrationEnv` that highway-env does not have."""

    density: Literal["sparse", "medium", "dense"]
    duration: Positive


class DemonstrationEnv(GameEnv):
    """A car to drive on a road of three lanes, among cars that do not react.

    Their routes are fixed when the episode starts. The configuration has highway-env's
    keys and these; changes act from the next reset on:

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
    others = max(DENSITIES.values())
    cars = 1 + others
    # State of absent cars: so far behind that they do not count.
    absent_state = np.array([-1000.0, 0.0, 0.0, 0.0])

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
        self,
        config: Config | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.game = demonstration_game()
        super().__init__(config, render_mode)

    def _reset(self) -> None:
        """Build the road and place the cars."""
        start = np.asarray(self._draw_start())

        # Routes go on for the horizon of a plan after the last step.
        steps = self.episode_steps + self.game.planner.horizon
        times = np.arange(steps + 1) * TIME_STEP
        lanes = np.asarray(self.game.scene.lanes, dtype=float)
        cars = DENSITIES[self.config["density"]]
        routes = draw_routes(self.np_random, cars, times, lanes, start)
        self.routes = np.tile(self.absent_state, (self.others, len(times), 1))
        self.routes[: len(routes)] = routes

        self.road = Road(straight_road(self.game), np_random=self.np_random)
        heading, speed = start[2:].tolist()
        driver = BicycleVehicle(self.road, start[:2], heading, speed)
        driver.color = HumanVehicle.COLOR
        others = [RoutedVehicle(self.road, route) for route in routes]
        self._place([driver, *others])

    def _draw_start(self) -> Car:
        """Draw the state of the driver at the start."""
        random = self.np_random
        draw = DRIVER_START
        scene = self.game.scene
        lanes = np.asarray(scene.lanes, dtype=float)
        half_lane = float(scene.lane_width) / 2

        # In a lane, or with one side off the road.
        centre = random.choice(lanes)
        y = centre + random.normal(scale=draw.lateral_spread)
        if random.uniform() < draw.off_road_share:
            depth = random.uniform(-draw.off_road_depth, 0)
            from_edge = depth + BicycleVehicle.WIDTH / 2
            left = lanes[0] - half_lane + from_edge
            right = lanes[-1] + half_lane - from_edge
            y = random.choice([left, right])

        heading = random.normal(scale=draw.heading_spread)
        speed = random.normal(float(self.game.robot.speed_limit), draw.speed_spread)
        return np.array([0.0, y, heading, speed])

    @property
    def present(self) -> np.ndarray:
        """Which of the cars are there, the driver first."""
        return np.arange(self.cars) < len(self.road.vehicles)

    @property
    def car_states(self) -> State:
        """``(x, y, heading, speed)`` of the driver and of the others in SI units.

        Absent ones stand far behind.
        """
        states = np.tile(self.absent_state, (self.cars, 1))
        states[: len(self.road.vehicles)] = states_of(self.road.vehicles)
        return states

    def action_for(self, control: Control) -> np.ndarray:
        """Return the action that executes a control ``(omega, acceleration)``.

        It is clipped to what actions reach.
        """
        omega, acceleration = np.asarray(control, dtype=float).tolist()
        steering = atan(omega * BicycleVehicle.LENGTH)
        kind = self.action_type
        shares = [
            np.interp(acceleration, kind.acceleration_range, [-1, 1]),
            np.interp(steering, kind.steering_range, [-1, 1]),
        ]
        return np.array(shares, dtype=np.float32)


def draw_routes(
    random: np.random.Generator,
    cars: int,
    times: Times,
    lanes: Vector,
    driver: np.ndarray,
) -> np.ndarray:
    """Draw the states of cars that keep clear of each other, [cars, times, 4].

    A state is ``(x, y, heading, speed)``. At the start, they also keep clear of the
    driver. Each car follows its lane at its own speed; some change to the adjacent lane
    along a quintic.

    Args:
        random: source of the draws.
        cars: number of cars.
        times: of the states [s].
        lanes: lateral positions of the lanes' centres, two or more.
        driver: state of the driver at the start; the routes start near it.
    """
    while True:
        routes: list[np.ndarray] = []
        for _ in range(ROUTE_DRAW.tries * cars):
            route = _draw_route(random, times, lanes, driver[0])
            clear_of_routes = all(_clear(route, other).all() for other in routes)
            clear_of_driver = _clear(route[0], driver)
            if clear_of_routes and clear_of_driver:
                routes.append(route)
            if len(routes) == cars:
                return np.array(routes)


def _draw_route(
    random: np.random.Generator,
    times: Times,
    lanes: Vector,
    x: float,
) -> np.ndarray:
    """Draw the states of a car at these times, [times, 4], which starts near x."""
    draw = ROUTE_DRAW
    lane = random.integers(len(lanes))
    speed = random.uniform(*draw.speeds)
    adjacent = (lane - 1, lane + 1)
    neighbours = [index for index in adjacent if 0 <= index < len(lanes)]
    next_lane = random.choice(neighbours)
    start = random.uniform(*draw.change_starts)
    duration = random.uniform(*draw.change_durations)
    changes = random.uniform() < draw.lane_change_share

    # A quintic from lane to lane: 10 s^3 - 15 s^4 + 6 s^5 of the width, where s is the
    # share of the lane change that is done; speed and acceleration across are 0 at its
    # ends.
    width = (lanes[next_lane] - lanes[lane]) * changes
    share = np.clip((times - start) / duration, 0, 1)
    y = lanes[lane] + width * share**3 * (10 - 15 * share + 6 * share**2)
    speed_across = width * 30 * (share * (1 - share)) ** 2 / duration

    along = x + random.uniform(*draw.places) + speed * times
    heading = np.arctan2(speed_across, speed)
    path_speed = np.hypot(speed_across, speed)
    return np.stack([along, y, heading, path_speed], axis=-1)


def _clear(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return whether two cars are apart, along the road or across it."""
    distance = np.abs(one[..., :2] - other[..., :2])
    apart_along = distance[..., 0] >= ROUTE_DRAW.gap
    apart_across = distance[..., 1] >= ROUTE_DRAW.side_gap
    return apart_along | apart_across
