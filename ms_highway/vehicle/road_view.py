"""What a driver sees of a highway-env road: its surroundings, straightened along the lane that it is on.

Whatever the shape of the road and however many drive on it, a view has arrays of the same shapes, so that the plans of
all drivers on all roads are compiled once.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import dist, pi
from typing import TypeAlias, TypeVar

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject
from jaxtyping import Float

from ms_highway.game.neighbours import FAR_AWAY, neighbours, places
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT
from ms_highway.game.scene import Scene

__all__ = [
    "MAX_LANES",
    "MAX_OBSTACLES",
    "RoadView",
    "Route",
    "along_route",
    "followed_lane",
    "look",
    "remaining_route",
    "states_of",
]

Number = TypeVar("Number", float, np.ndarray)
LaneIndex: TypeAlias = tuple[str, str, int]
Route: TypeAlias = list[tuple[str, str, int | None]]
"""Roads to take one after the other, as highway-env's vehicles have them; which of a road's lanes may be left open."""

MAX_LANES = 6
MAX_OBSTACLES = 4

SIGHT = 100.0  # m, in which cars are seen
OBSTACLE_SIGHT = (-10.0, 60.0)  # m behind and ahead, where obstacles are seen
TAPER = (80.0, 20.0)  # m before the end of a lane that does not go on, between which it runs into its neighbour
PREVIEW = 0.1  # s, over which the bend of the lane is averaged
BENDS_SEEN, BENDS_SPACING = 12, 5.0  # how many stretches of road ahead are looked at for bends, and their length [m]
STRAIGHT = 1e-6  # 1/m, the curvature of a straight road
CORNERING = 4.0  # m/s^2, to the side, in bends that are seen ahead
SLOWING = 3.0  # m/s^2, before them
SLOWEST = 3.0  # m/s, in any bend


@dataclass(frozen=True)
class RoadView:
    """A driver's surroundings in the coordinates of its lane: x along it from the driver on, y to the right of it.

    Attributes:
        scene: `MAX_LANES` lanes and `MAX_OBSTACLES` obstacles. Where there are fewer lanes, the rightmost is repeated;
            where there are fewer obstacles, the others are far behind. The target lane is the one that the route
            names for the road, or else the nearest.
        states: of the driver and its `neighbours`.
        cars: the neighbours, None where there is none.
        speed_limit: of the lane and, lower, where it has to slow down for bends ahead [m/s].
        route: what is left of the driver's, from the road that it is on; without a route, this road only.
        lane: that the driver is on.
        place: of the driver, along the lane [m].
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
        """States of cars, as highway-env has them, in the coordinates of the lane."""
        return _straightened(self.lane, self.place, states)


def states_of(cars: Iterable[Vehicle]) -> Float[np.ndarray, "cars 4"]:
    """``(x, y, heading, speed)`` of any of highway-env's vehicles."""
    return np.array([(*car.position, car.heading, car.speed) for car in cars], dtype=float)


def look(driver: Vehicle, route: Route | None = None) -> RoadView:
    """What a driver sees now of the road that it is on.

    Cars further away than 100 m are left out, and so are `Landmark` objects, which nobody runs into.

    Args:
        driver: who looks; its own size is what it takes all cars to have.
        route: the roads that it follows, None to follow whichever road it is on.
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
        bend=_wrapped(lane.heading_at(place + ahead) - lane.heading_at(place)) / ahead,
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
    """What is left of a route for who is on this lane; this lane only, if it does not lead on to the route."""
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
    """Positions in the middle of lanes, and headings there, along a route; beyond its end, along its last lane.

    Args:
        network: of roads.
        route: from the road of the lane on.
        index: of the lane.
        places: how far from the beginning of the lane, ascending [m].
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


def _bend_limit(network: RoadNetwork, route: Route, index: LaneIndex, place: float) -> float:
    """The speed [m/s] from which all bends ahead can be reached slowly enough, without braking hard.

    Args:
        network: of roads.
        route: from the road on that the driver is on.
        index: of its lane.
        place: along that lane [m].
    """
    _, headings = along_route(network, route, index, place + BENDS_SPACING * np.arange(BENDS_SEEN + 1))
    bends = np.maximum(np.abs(_wrapped(np.diff(headings))) / BENDS_SPACING, STRAIGHT)
    ahead = BENDS_SPACING * np.arange(BENDS_SEEN)
    return float(np.sqrt(np.maximum(CORNERING / bends, SLOWEST**2) + 2 * SLOWING * ahead).min())


def followed_lane(driver: Vehicle, route: Route | None) -> LaneIndex:
    """The lane that a driver is on; where roads part or cross, the nearest one on its route."""
    if not route:
        return driver.lane_index
    network = driver.road.network
    lanes = [index for start, end, _ in route for index in network.all_side_lanes((start, end, 0))]
    return min(lanes, key=lambda index: network.get_lane(index).distance_with_heading(driver.position, driver.heading))


def _wrapped(angle: Number) -> Number:
    return (angle + pi) % (2 * pi) - pi


def _straightened(lane: AbstractLane, place: float, states: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "cars 4"]:
    """States of cars, as highway-env has them, in the coordinates of a lane, x from ``place`` on."""
    straight = []
    for *position, heading, speed in states:
        x, y = lane.local_coordinates(np.array(position))
        straight.append((x - place, y, _wrapped(heading - lane.heading_at(x)), speed))
    return np.array(straight, dtype=float)


def _obstacles(
    lane: AbstractLane, start: float, objects: Iterable[RoadObject]
) -> tuple[Float[np.ndarray, "obstacles 2"], Float[np.ndarray, "2"]]:
    """Positions of the nearest obstacles in the coordinates of a lane, and the largest's size, which all count for."""
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
    """Centres of the road's lanes beside a driver, in the coordinates of the lane of this index.

    A lane that ends where the road goes on, such as a ramp, tapers: over the last of its length its centre moves to
    that of the nearest lane that goes on, and who follows it merges.
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
    """Whether another lane begins at the end of this one."""
    end, reach = lane.position(lane.length, 0), lane.width_at(lane.length) / 2
    return any(dist(start, end) < reach for start in starts)


def _nearest(numbers: Iterable[float], number: float) -> list[float]:
    """Numbers by their distance to another, the nearest first."""
    return sorted(numbers, key=lambda other: abs(other - number))


def _lanes_ahead(network: RoadNetwork, node: str, route: Route | None) -> list[AbstractLane]:
    """The lanes that begin at a node: those on the route, if it leads on from there, or else all."""
    roads = network.graph.get(node, {})
    chosen = [end for start, end, _ in route or () if start == node]
    return [lane for end, lanes in roads.items() if not chosen or end in chosen for lane in lanes]
