"""Traffic that does not react: routes of cars that are worked out beforehand and never collide with each other."""

import numpy as np

from ms_highway.game.arrays import Car, Times
from ms_highway.runtime.arrays import Vector

DENSITIES = {"sparse": 2, "medium": 4, "dense": 7}
"""Number of cars around a driver, by name of the density of traffic."""

NEAR = (-30.0, 60.0)  # m along the road, where routes start
SPEEDS = (18.0, 20.0)  # m/s along the road
LANE_CHANGES = 0.4  # share of the cars that change lane
CHANGE_STARTS, CHANGE_LASTS = (0.0, 2.5), (2.5, 3.5)  # s
GAP, SIDE_GAP = 8.0, 2.8  # m between centres; two cars keep one of them at all times (cars are 5 m x 2.5 m)
TRIES = 200  # for one car, before all are drawn again


def draw_routes(
    random: np.random.Generator,
    cars: int,
    times: Times,
    lanes: Vector,
    driver: Car,
) -> np.ndarray:
    """Return states ``(x, y, heading, speed)``, [cars, times, 4], of cars that keep clear of each other.

    At first, they keep clear of a driver as well. Each goes along its lane at its speed; some change to the lane beside
    it, along a quintic.

    Args:
        random: what they are drawn with.
        cars: how many.
        times: of the states [s].
        lanes: lateral position of each lane's centre, two or more.
        driver: state of the driver in the beginning; the routes start near it.
    """
    routes: list[np.ndarray] = []
    while len(routes) < cars:
        routes = []
        for _ in range(TRIES * cars):
            route = _draw_route(random, times, lanes, driver[0])
            if _clear(route[0], driver) and all(_clear(route, other).all() for other in routes):
                routes.append(route)
            if len(routes) == cars:
                break
    return np.array(routes).reshape(cars, len(times), 4)


def _draw_route(random: np.random.Generator, times: Times, lanes: Vector, x: float) -> np.ndarray:
    lane, speed = random.integers(len(lanes)), random.uniform(*SPEEDS)
    beside = random.choice([place for place in (lane - 1, lane + 1) if 0 <= place < len(lanes)])
    start, lasts = random.uniform(*CHANGE_STARTS), random.uniform(*CHANGE_LASTS)
    width = (lanes[beside] - lanes[lane]) * (random.uniform() < LANE_CHANGES)
    share = np.clip((times - start) / lasts, 0, 1)
    y = lanes[lane] + width * share**3 * (10 - 15 * share + 6 * share**2)
    sideways = width * 30 * (share * (1 - share)) ** 2 / lasts
    along = x + random.uniform(*NEAR) + speed * times
    return np.stack([along, y, np.arctan2(sideways, speed), np.hypot(sideways, speed)], axis=-1)


def _clear(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return whether two cars are apart, along the road or across it."""
    apart = np.abs(one[..., :2] - other[..., :2])
    return (apart[..., 0] >= GAP) | (apart[..., 1] >= SIDE_GAP)
