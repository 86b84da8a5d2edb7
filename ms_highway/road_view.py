"""What a driver sees of a highway-env road: its surroundings, straightened along the lane that it is on.

Whatever the shape of the road and however many drive on it, a view has arrays of the same shapes, so that the plans of
all drivers on all roads are compiled once.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import dist, pi
from typing import TypeAlias

import numpy as np
from highway_env.road.lane import AbstractLane
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject
from jaxtyping import Float

from ms_highway.neighbours import FAR_AWAY, neighbours
from ms_highway.scenario import PAPER_UNIT
from ms_highway.scene import Scene

__all__ = ["MAX_LANES", "MAX_OBSTACLES", "RoadView", "Route", "followed_lane", "look"]

LaneIndex: TypeAlias = tuple[str, str, int]
Route: TypeAlias = list[tuple[str, str, int | None]]
"""Roads to take one after the other, as highway-env's vehicles have them; which of a road's lanes may be left open."""

MAX_LANES = 6
MAX_OBSTACLES = 4

SIGHT = 100.0  # m, in which cars are seen
OBSTACLE_SIGHT = (-10.0, 60.0)  # m behind and ahead, where obstacles are seen
TAPER = (80.0, 20.0)  # m before the end of a lane that does not go on, between which it runs into its neighbour
PREVIEW = 0.1  # s, over which the bend of the lane is averaged


@dataclass(frozen=True)
class RoadView:
    """A driver's surroundings in the coordinates of its lane: x along it from the driver on, y to the right of it.

    Attributes:
        scene: `MAX_LANES` lanes and `MAX_OBSTACLES` obstacles. Where there are fewer lanes, the rightmost is repeated;
            where there are fewer obstacles, the others are far behind.
        states: of the driver and its `neighbours`.
        speed_limit: of the lane [m/s], None without one.
        curvature: of the lane at the driver [1/m], positive to the right.
    """

    scene: Scene
    states: Float[np.ndarray, "7 4"]
    speed_limit: float | None
    curvature: float


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
    start, lateral = lane.local_coordinates(driver.position)
    width = float(lane.width_at(start))
    seen = [car for car in others if car is not driver and dist(car.position, driver.position) < SIGHT]
    states = _states(lane, start, [driver, *seen, driver])  # at least one other, which is not there
    around = neighbours(states[0], states[1:], np.arange(len(seen) + 1) < len(seen), np.array(width))
    obstacles, obstacle_size = _obstacles(lane, start, driver.road.objects)
    nearest = _nearest(_lanes(network, index, route, driver), lateral)
    lanes = sorted(nearest[:MAX_LANES])
    scene = Scene(
        lanes=np.array(lanes + lanes[-1:] * (MAX_LANES - len(lanes))),
        lane_width=width,
        obstacles=obstacles,
        obstacle_size=obstacle_size,
        car_size=np.array([driver.LENGTH, driver.WIDTH]),
        corner=0.5,
        target_lane=nearest[0],
        length_unit=PAPER_UNIT,
    )
    ahead = max(driver.speed * PREVIEW, 0.5)
    bend = _wrapped(lane.heading_at(start + ahead) - lane.heading_at(start)) / ahead
    return RoadView(scene, np.concatenate([states[:1], around]), lane.speed_limit, bend)


def followed_lane(driver: Vehicle, route: Route | None) -> LaneIndex:
    """The lane that a driver is on; where roads part or cross, the nearest one on its route."""
    if not route:
        return driver.lane_index
    network = driver.road.network
    lanes = [index for start, end, _ in route for index in network.all_side_lanes((start, end, 0))]
    return min(lanes, key=lambda index: network.get_lane(index).distance_with_heading(driver.position, driver.heading))


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi


def _states(lane: AbstractLane, start: float, cars: Iterable[Vehicle]) -> Float[np.ndarray, "cars 4"]:
    """States of cars in the coordinates of a lane, x from ``start`` on."""
    states = []
    for car in cars:
        x, y = lane.local_coordinates(car.position)
        states.append((x - start, y, _wrapped(car.heading - lane.heading_at(x)), car.speed))
    return np.array(states, dtype=float)


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
