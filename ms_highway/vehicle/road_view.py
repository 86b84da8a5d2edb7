"""View a highway-env road from a driver: its surroundings, straightened along its lane.

Views have arrays of the same shapes for all roads and any number of vehicles, so that plans are compiled once.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import dist
from typing import TypeAlias

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject
from jaxtyping import Float

from ms_highway.game.neighbours import FAR_AWAY, neighbours, places
from ms_highway.game.road import wrapped
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT
from ms_highway.game.scene import Scene

__all__ = [
    "MAX_LANES",
    "MAX_OBSTACLES",
    "RoadView",
    "Route",
    "along_route",
    "at_constant_speed",
    "followed_lane",
    "look",
    "remaining_route",
    "states_of",
]

LaneIndex: TypeAlias = tuple[str, str, int]
Route: TypeAlias = list[tuple[str, str, int | None]]
"""Roads to follow in order, as in highway-env's vehicles; the lane of a road may be None."""

MAX_LANES = 6
MAX_OBSTACLES = 4

SIGHT = 100.0  # m, of cars
OBSTACLE_SIGHT = (-10.0, 60.0)  # m, behind and ahead, of obstacles
TAPER = (80.0, 20.0)  # m before the end of a lane that ends, between which it merges with its neighbour
PREVIEW = 0.1  # s, over which the bend of the lane is averaged
BENDS_SEEN, BENDS_SPACING = 12, 5.0  # number and length [m] of the segments ahead that are checked for bends
STRAIGHT = 1e-6  # 1/m, the curvature of a straight road
CORNERING = 4.0  # m/s^2, lateral, in bends ahead
SLOWING = 3.0  # m/s^2, deceleration before them
SLOWEST = 3.0  # m/s, in any bend


@dataclass(frozen=True)
class RoadView:
    """Surroundings of a driver in the coordinates of its lane: x along it from the driver on, y to the right.

    Attributes:
        scene: `MAX_LANES` lanes, missing ones repeat the rightmost, and `MAX_OBSTACLES` obstacles, missing ones are far
            behind. The target lane is that of the route or else the nearest.
        states: of the driver and its `neighbours`.
        cars: the neighbours, None where there is none.
        speed_limit: of the lane, reduced before bends [m/s].
        route: the driver's, from its present road on; without a route, this road only.
        lane: of the driver.
        place: position of the driver along the lane [m].
    """

    scene: Scene
    states: Float[np.ndarray, "7 4"]
    cars: tuple[Vehicle | None, ...]
    speed_limit: float
    route: Route
    lane: AbstractLane
    place: float

    @property
    def bend(self) -> float:
        """Curvature of the lane at the driver [1/m], positive to the right."""
        return float(self.scene.bend or 0.0)

    def straightened(self, states: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "cars 4"]:
        """Transform states of cars from highway-env's coordinates to those of the lane."""
        return _straightened(self.lane, self.place, states)


def states_of(cars: Iterable[Vehicle]) -> Float[np.ndarray, "cars 4"]:
    """Return ``(x, y, heading, speed)`` of highway-env vehicles."""
    return np.array([(*car.position, car.heading, car.speed) for car in cars], dtype=float)


def look(driver: Vehicle, route: Route | None = None) -> RoadView:
    """View the road from a driver now.

    Cars further away than 100 m and `Landmark` objects, which are not solid, are left out.

    Args:
        driver: whose size is assumed for all cars.
        route: roads that it follows, None to follow whichever road it is on.
    """
    network, others = driver.road.network, driver.road.vehicles
    index = followed_lane(driver, route)
    lane = network.get_lane(index)
    place, lateral = lane.local_coordinates(driver.position)
    width = float(lane.width_at(place))
    seen = [car for car in others if car is not driver and dist(car.position, driver.position) < SIGHT]
    states = _straightened(lane, place, states_of([driver, *seen, driver]))  # at least one other, which is not there
    present = np.arange(len(seen) + 1) < len(seen)
    around = neighbours(states[0], states[1:], present, np.array(width))
    numbers, taken = places(states[0], states[1:], present, np.array(width))
    obstacles, obstacle_size = _obstacles(lane, place, driver.road.objects)
    centres = _lanes(network, index, route, driver)
    nearest = _nearest(centres, lateral)
    lanes = sorted(nearest[:MAX_LANES])
    left = remaining_route(route or [(*index[:2], None)], index)
    ahead = max(driver.speed * PREVIEW, 0.5)
    scene = Scene(
        lanes=np.array(lanes + lanes[-1:] * (MAX_LANES - len(lanes))),
        lane_width=width,
        obstacles=obstacles,
        obstacle_size=obstacle_size,
        car_size=np.array([driver.LENGTH, driver.WIDTH]),
        corner=0.5,
        target_lane=nearest[0] if left[0][2] is None else centres[left[0][2]],
        length_unit=PAPER_UNIT,
        bend=wrapped(lane.heading_at(place + ahead) - lane.heading_at(place)) / ahead,
    )
    return RoadView(
        scene,
        np.concatenate([states[:1], around]),
        tuple(seen[number] if there else None for number, there in zip(numbers, taken, strict=True)),
        min(lane.speed_limit or SPEED_LIMIT * PAPER_UNIT, _bend_limit(network, left, index, place)),
        left,
        lane,
        place,
    )


def remaining_route(route: Route, index: LaneIndex) -> Route:
    """Return the rest of a route from a lane on; only this lane, if it does not lead to the route."""
    for number, leg in enumerate(route):
        if leg[:2] == index[:2]:
            return route[number:]
    for number, leg in enumerate(route):
        if leg[0] == index[1]:
            return [index, *route[number:]]
    return [index]


def along_route(
    network: RoadNetwork, route: Route, index: LaneIndex, places: Float[np.ndarray, "places"]
) -> tuple[list[Float[np.ndarray, "2"]], list[float]]:
    """Return positions in the middle of lanes, and headings, along a route; beyond its end, along its last lane.

    Args:
        network: of roads.
        route: from the road of the lane on.
        index: of the lane.
        places: distances from the beginning of the lane, ascending [m].
    """
    positions, headings, passed, lane, legs = [], [], 0.0, network.get_lane(index), iter(route[1:])
    for place in places.tolist():
        while place - passed > lane.length and (leg := next(legs, None)) is not None:
            passed += lane.length
            number, _ = network.next_lane_given_next_road(*index, leg[1], leg[2], lane.position(lane.length, 0))
            index = (*leg[:2], number)
            lane = network.get_lane(index)
        positions.append(lane.position(place - passed, 0))
        headings.append(lane.heading_at(place - passed))
    return positions, headings


def at_constant_speed(
    vehicle: Vehicle, times: Float[np.ndarray, "times"]
) -> tuple[list[Float[np.ndarray, "2"]], list[float]]:
    """Predict positions and headings of a vehicle at times from now [s], at constant speed along its lane and route."""
    index, network = vehicle.lane_index, vehicle.road.network
    place, _ = network.get_lane(index).local_coordinates(vehicle.position)
    route = remaining_route(vehicle.route or [index], index)
    return along_route(network, route, index, place + vehicle.speed * np.asarray(times))


def _bend_limit(network: RoadNetwork, route: Route, index: LaneIndex, place: float) -> float:
    """Return the highest speed [m/s] from which moderate braking suffices for all bends ahead.

    Args:
        network: of roads.
        route: from the driver's road on.
        index: of its lane.
        place: position along that lane [m].
    """
    _, headings = along_route(network, route, index, place + BENDS_SPACING * np.arange(BENDS_SEEN + 1))
    bends = np.maximum(np.abs(wrapped(np.diff(headings))) / BENDS_SPACING, STRAIGHT)
    ahead = BENDS_SPACING * np.arange(BENDS_SEEN)
    return float(np.sqrt(np.maximum(CORNERING / bends, SLOWEST**2) + 2 * SLOWING * ahead).min())


def followed_lane(driver: Vehicle, route: Route | None) -> LaneIndex:
    """Return the lane of a driver; with a route, the nearest lane on it."""
    if not route:
        return driver.lane_index
    network = driver.road.network
    lanes = [index for start, end, _ in route for index in network.all_side_lanes((start, end, 0))]
    return min(lanes, key=lambda index: network.get_lane(index).distance_with_heading(driver.position, driver.heading))


def _straightened(lane: AbstractLane, place: float, states: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "cars 4"]:
    """Transform states of cars from highway-env's coordinates to those of a lane, with x from ``place`` on."""
    straight = []
    for *position, heading, speed in states:
        x, y = lane.local_coordinates(np.array(position))
        straight.append((x - place, y, wrapped(heading - lane.heading_at(x)), speed))
    return np.array(straight, dtype=float)


def _obstacles(
    lane: AbstractLane, start: float, objects: Iterable[RoadObject]
) -> tuple[Float[np.ndarray, "obstacles 2"], Float[np.ndarray, "2"]]:
    """Return positions of the nearest obstacles in the coordinates of a lane, and the largest size, assumed for all."""
    behind, ahead = OBSTACLE_SIGHT
    seen = []
    for item in objects:
        x, y = lane.local_coordinates(item.position)
        if behind < x - start < ahead and not isinstance(item, Landmark):
            seen.append((x - start, y, item.LENGTH, item.WIDTH))
    seen = sorted(seen, key=lambda item: abs(item[0]))[:MAX_OBSTACLES]
    absent = [(-FAR_AWAY, 0.0, 1.0, 1.0)] * (MAX_OBSTACLES - len(seen))
    table = np.array(seen + absent)
    return table[:, :2], table[:, 2:].max(axis=0)


def _lanes(network: RoadNetwork, index: LaneIndex, route: Route | None, driver: Vehicle) -> list[float]:
    """Return the centres of the road's lanes beside a driver, in the coordinates of the lane of this index.

    A lane that ends where the road continues, such as a ramp, tapers: towards its end its centre moves to that of the
    nearest lane that continues, so that its followers merge.
    """
    lane = network.get_lane(index)
    sides = [network.get_lane(side) for side in network.all_side_lanes(index)]
    along = [side.local_coordinates(driver.position)[0] for side in sides]
    centres = [lane.local_coordinates(side.position(x, 0))[1] for side, x in zip(sides, along, strict=True)]
    starts = [following.position(0, 0) for following in _lanes_ahead(network, index[1], route)]
    onward = [centre for side, centre in zip(sides, centres, strict=True) if _goes_on(side, starts)]
    if not onward:
        return centres
    first, last = TAPER
    for number, (side, x) in enumerate(zip(sides, along, strict=True)):
        centre = centres[number]
        if centre not in onward:
            share = min(max((first - (side.length - x)) / (first - last), 0.0), 1.0)
            centres[number] += share * (_nearest(onward, centre)[0] - centre)
    return centres


def _goes_on(lane: AbstractLane, starts: Iterable[Float[np.ndarray, "2"]]) -> bool:
    """Return whether another lane begins at the end of this one."""
    end, reach = lane.position(lane.length, 0), lane.width_at(lane.length) / 2
    return any(dist(start, end) < reach for start in starts)


def _nearest(numbers: Iterable[float], number: float) -> list[float]:
    """Sort numbers by their distance to another."""
    return sorted(numbers, key=lambda other: abs(other - number))


def _lanes_ahead(network: RoadNetwork, node: str, route: Route | None) -> list[AbstractLane]:
    """Return the lanes that begin at a node: those on the route, if it continues there, or else all."""
    roads = network.graph.get(node, {})
    chosen = [end for start, end, _ in route or () if start == node]
    return [lane for end, lanes in roads.items() if not chosen or end in chosen for lane in lanes]
