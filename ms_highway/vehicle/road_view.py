"""View a highway-env road from a driver: its surroundings, straightened along the smooth curve of the lanes ahead.

Views have arrays of the same shapes for all roads and any number of vehicles, so that plans are compiled once.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import dist
from typing import TypeAlias

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark

from ms_highway.game.neighbours import FAR_AWAY, far_behind, places
from ms_highway.game.scenario import PAPER_UNIT
from ms_highway.game.scene import Scene
from ms_highway.geometry.curve import Curve
from ms_highway.geometry.lane_paths import FINE, Point, Row
from ms_highway.geometry.road_map import BLOCK, Chain, Lane, Lanes, road_map
from ms_highway.runtime.arrays import State

Route: TypeAlias = list[tuple[str, str, int | None]]
"""Roads to follow in order, as in highway-env's vehicles; the lane of a road may be None."""

MAX_LANES = 6
MAX_OBSTACLES = 4

SIGHT = 100.0  # m, in which cars are looked for: to stop from 30 m/s takes 75 m
BACKWARDS = 50.0  # m, of the curve behind the driver
OBSTACLE_SIGHT = (-10.0, 60.0)  # m, behind and ahead, of obstacles
TAPER = (80.0, 20.0)  # m before the end of a lane that ends, between which it merges with its neighbour
BENDS_SEEN = 60.0  # m ahead
STRAIGHT = 1e-6  # 1/m, the curvature of a straight road
CORNERING = 6.0  # m/s^2, lateral, in bends ahead: less than tyres hold, so that braking leaves room for steering
SLOWING = 3.0  # m/s^2, deceleration before them
SLOWEST = 3.0  # m/s, in any bend


@dataclass(frozen=True)
class RoadView:
    """Surroundings of a driver in the coordinates of its curve: x along it from the driver on, y to the right.

    Attributes:
        scene: `MAX_LANES` lanes, missing ones repeat the rightmost, and `MAX_OBSTACLES` obstacles, missing ones are far
            behind. The target lane is that of the route or else the nearest.
        states: of the driver and its neighbours.
        cars: the neighbours, None where there is none.
        speed_limit: of the lane, reduced before bends [m/s].
        route: the driver's, from its present road on; without a route, this road only.
        curve: along the lanes near the driver; where its own lane ends, along the nearest one that goes on.
        place: position of the driver along the curve [m].
    """

    scene: Scene
    states: State
    cars: tuple[Vehicle | None, ...]
    speed_limit: float
    route: Route
    curve: Curve
    place: float

    @property
    def bend(self) -> float:
        """Curvature of the road at the driver [1/m], positive to the right."""
        return float(self.scene.bend or 0.0)

    def straightened(self, states: State) -> State:
        """Transform states of cars from highway-env's coordinates to those of the curve."""
        return _straightened(self.curve, self.place, states)


def states_of(cars: Iterable[Vehicle]) -> State:
    """Return ``(x, y, heading, speed)`` of highway-env vehicles."""
    return np.array([(*car.position, car.heading, car.speed) for car in cars], dtype=float)


def look(driver: Vehicle, route: Route | None = None) -> RoadView:
    """View the road from a driver now.

    Cars further away than 100 m and `Landmark` objects, which are not solid, are left out.

    Args:
        driver: whose size is assumed for all cars.
        route: roads that it follows, None to follow whichever road it is on.
    """
    lane = followed_lane(driver, route)
    left = remaining_route(route or [(lane.start, lane.end, None)], lane.index)
    onward = _leading_on(lane, left)
    curve, place = _curve_along(min(onward or [lane], key=lambda side: abs(side.number - lane.number)), left, driver)
    seen = [car for car in driver.road.vehicles if car is not driver and dist(car.position, driver.position) < SIGHT]
    # at least one other, which is not there
    own, *others = _straightened(curve, place, states_of([driver, *seen, driver]))
    width = float(lane.shape.width_at(lane.shape.local_coordinates(driver.position)[0]))
    numbers, taken = places(own, np.array(others), np.arange(len(others)) < len(seen), np.array(width))
    obstacles, obstacle_size = _solid(curve, place, driver)
    centres = _centres(curve, lane, onward, driver.position)
    nearest = sorted(centres, key=lambda centre: abs(centre - own[1]))
    lanes = sorted(nearest[:MAX_LANES])
    scene = Scene(
        lanes=np.array(lanes + lanes[-1:] * (MAX_LANES - len(lanes))),
        lane_width=width,
        obstacles=obstacles,
        obstacle_size=obstacle_size,
        car_size=np.array([driver.LENGTH, driver.WIDTH]),
        corner=0.5,
        target_lane=nearest[0] if left[0][2] is None else centres[left[0][2]],
        length_unit=PAPER_UNIT,
        bend=float(curve.bend(place)),
    )
    return RoadView(
        scene,
        np.stack([own, *np.where(taken[:, None], np.array(others)[numbers], far_behind(own))]),
        tuple(seen[number] if there else None for number, there in zip(numbers, taken, strict=True)),
        min(lane.limit, _limit_before_bends(curve, place)),
        left,
        curve,
        place,
    )


def followed_lane(driver: Vehicle, route: Route | None) -> Lane:
    """Return the lane of a driver; with a route, the nearest lane on it."""
    roads = road_map(driver.road.network)
    on_route = [lane for start, end, _ in route or () for lane in roads.road(start, end)]
    return min(on_route or [roads.lanes[driver.lane_index]], key=lambda lane: lane.distance(driver))


def remaining_route(route: Route, index: LaneIndex) -> Route:
    """Return the rest of a route from a lane on; only this lane, if it does not lead to the route."""
    own = [route[number:] for number, leg in enumerate(route) if leg[:2] == index[:2]]
    next_own = [[index, *route[number:]] for number, leg in enumerate(route) if leg[0] == index[1]]
    return [*own, *next_own, [index]][0]


def route_ahead(lane: Lane, route: Route) -> Chain:
    """Return the lanes of a driver on a route, which begins with its road."""
    lanes = [lane]
    for _, end, number in route[1:]:
        lanes.append(lanes[-1].continued(end, number))
    return lane.roads.chain(tuple(lanes))


def at_constant_speed(vehicle: Vehicle, times: Row) -> tuple[list[Point], list[float]]:
    """Predict positions and headings of a vehicle at times from now [s], at constant speed along its lane and route."""
    lane = followed_lane(vehicle, None)
    chain = route_ahead(lane, remaining_route(getattr(vehicle, "route", None) or [lane.index], lane.index))
    place, _ = lane.shape.local_coordinates(vehicle.position)
    positions, headings = zip(*map(chain.at, place + vehicle.speed * np.asarray(times)), strict=True)
    return list(positions), list(headings)


def _leading_on(lane: Lane, route: Route) -> Lanes:
    """Return the lanes of a lane's road that lead to the next road of a route, or without one to any."""
    wanted = {leg[1] for leg in route[1:2]}
    return tuple(side for side in lane.siblings if (side.touched & wanted if wanted else side.touched))


def _curve_along(lane: Lane, route: Route, driver: Vehicle) -> tuple[Curve, float]:
    """Return the curve along a lane and the route after it, near a driver, and the driver's place on it [m]."""
    behind = lane.behind(BACKWARDS)
    chain = lane.roads.chain((*behind, *route_ahead(lane, route).lanes))
    way = chain.starts[len(behind)] + float(lane.shape.local_coordinates(driver.position)[0])
    whole = chain.curve(way // BLOCK)
    place, _, _ = whole.project(driver.position, driver.heading, way)
    first = max(int((place - BACKWARDS) / FINE), 0)
    return whole.curve.part(first, int((place + SIGHT) / FINE)), place


def _limit_before_bends(curve: Curve, place: float) -> float:
    """Return the highest speed [m/s] from which moderate braking suffices for all bends ahead of a place [m]."""
    ahead = np.arange(0.0, BENDS_SEEN)
    bends = np.maximum(np.abs(curve.bend(place + ahead)), STRAIGHT)
    return float(np.sqrt(np.maximum(CORNERING / bends, SLOWEST**2) + 2 * SLOWING * ahead).min())


def _straightened(curve: Curve, place: float, states: State) -> State:
    """Transform states of cars from highway-env's coordinates to those of a curve, with x from ``place`` on."""
    x, y, heading, speed = states.T
    s, d, turned = curve.project(x, y, heading)
    return np.stack([s - place, d, turned, speed], axis=-1)


def _solid(curve: Curve, place: float, driver: Vehicle) -> tuple[State, Point]:
    """Return where the nearest obstacles are in the coordinates of a curve, and the largest size, assumed for all."""
    solid = [item for item in driver.road.objects if not isinstance(item, Landmark)]
    s, d = curve.locate(np.array([item.position for item in solid]).reshape(-1, 2))
    placed = [(x, y, item.LENGTH, item.WIDTH) for x, y, item in zip(s - place, d, solid, strict=True)]
    near = [item for item in placed if OBSTACLE_SIGHT[0] < item[0] < OBSTACLE_SIGHT[1]]
    absent = [(-FAR_AWAY, 0.0, 1.0, 1.0)] * MAX_OBSTACLES
    table = np.array([*sorted(near, key=lambda item: abs(item[0])), *absent][:MAX_OBSTACLES])
    return table[:, :2], table[:, 2:].max(axis=0)


def _centres(curve: Curve, lane: Lane, onward: Lanes, position: Point) -> list[float]:
    """Return the centres of the road's lanes beside a position, in the coordinates of a curve.

    A lane that ends where the road continues, such as a ramp, tapers: towards its end its centre moves to that of the
    nearest lane that continues, so that its followers merge.
    """
    along = [side.shape.local_coordinates(position)[0] for side in lane.siblings]
    middles = [side.shape.position(x, 0) for side, x in zip(lane.siblings, along, strict=True)]
    centres = curve.locate(np.array(middles))[1].tolist()
    kept = [centres[side.number] for side in onward]
    first, last = TAPER
    for side, x in zip(lane.siblings, along, strict=True):
        if kept and side not in onward:
            centre = centres[side.number]
            share = np.clip((first - side.length + x) / (first - last), 0.0, 1.0)
            centres[side.number] += share * (min(kept, key=lambda other: abs(other - centre)) - centre)
    return centres
