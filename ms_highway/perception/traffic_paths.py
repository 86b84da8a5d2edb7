"""Find the paths that other vehicles may take, and the car ahead on each of them."""

from math import dist, sin
from typing import Any, NamedTuple

import jax
import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject

from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.geometry.curve import BEHIND, SPACING, Curve, wrapped
from ms_highway.geometry.lane_paths import Points, Row
from ms_highway.geometry.road_map import BLOCK, LIMIT, Chain, Lane, Lanes, RoadMap, kept
from ms_highway.perception.scene import TRAFFIC, TRAFFIC_KNOTS, Places

AHEAD, ONCOMING, BEHIND_SIGHT = 120.0, 250.0, 60.0  # m, range of sight: ahead, for oncoming vehicles, and behind
MAX_VEHICLES, MAX_WAYS = 16, 3
BRANCHING_DISTANCE = 60.0  # m ahead within which paths may branch
ONCOMING_COSINE = -0.7  # cosine of the angle between headings below which a vehicle is oncoming
PATH_LENGTH = 140.0  # m
TENS = 10.0  # m, resolution of the rest of a lane
CROOKED = 0.8  # widths of a lane: others take joints that the robot does not, such as exits from inner lanes
ON_LANE, ALONG = 1.0, 0.3  # m and rad, offsets up to which a vehicle may follow a lane that begins where its own does
IN_FRONT, LEADER_AHEAD = 1.5, 100.0  # m, lateral and longitudinal distance up to which a vehicle leads another
MIN_SPEED = 0.1  # m/s, lowest speed limit of pedestrians
FAR = -1e4  # m, coordinates of unused paths
LINE = SPACING * np.arange(TRAFFIC_KNOTS, dtype=np.float32)


class Way(NamedTuple):
    """A path that a vehicle may take.

    Attributes:
        owner: number of the vehicle or obstacle, -1 without one.
        position: of its centre [m].
        size: length and width [m].
        moves: whether it can move.
        path: along its lanes.
        state: on the path.
        limit: speed limit [m/s].
    """

    owner: int
    position: Any
    size: tuple[float, float]
    moves: bool
    path: Curve
    state: Any
    limit: float


NO_WAY = Way(
    -1,
    (FAR, FAR),
    (5.0, 2.0),
    False,
    Curve(LINE + np.float32(FAR), np.full_like(LINE, FAR), 0 * LINE, 0 * LINE),
    (0.0, 0.0, 0.0, 0.0),
    LIMIT,
)
"""An unused path."""


def traffic_of(vehicle: Vehicle, roads: RoadMap, numbers: dict[RoadObject, int], intentions: bool) -> dict[str, Any]:
    """Return the fields of a ``RoadScene`` that describe others, nearest first.

    Args:
        vehicle: the robot.
        roads: map of its network.
        numbers: of all vehicles seen so far; new vehicles are added.
        intentions: whether the routes of others are known.
    """
    ways = []
    for car in _in_sight(vehicle):
        ways += _ways(car, numbers.setdefault(car, len(numbers)), roads, intentions)
    ways = [*ways, *[NO_WAY] * TRAFFIC][:TRAFFIC]
    owners, positions, sizes, moving, paths, states, limits = zip(*ways, strict=True)
    curves, numbered = jax.tree.map(lambda *knots: np.stack(knots), *paths), np.array(owners, np.int32)
    leaders, gaps = _leaders_of(curves, np.array(positions), numbered)
    return {
        "paths": curves,
        "states": np.array(states, np.float32),
        "sizes": np.array(sizes, np.float32),
        "limits": np.array(limits, np.float32),
        "owners": numbered,
        "moving": np.array(moving),
        "leaders": leaders,
        "gaps": gaps,
        "accelerations": np.zeros(TRAFFIC, np.float32),
    }


def _in_sight(vehicle: Vehicle) -> list[RoadObject]:
    """Return vehicles and solid objects in sight, nearest first."""
    others = [car for car in vehicle.road.vehicles if car is not vehicle]
    others += [item for item in vehicle.road.objects if not isinstance(item, Landmark)]

    def distance(car: RoadObject) -> float:
        return dist(car.position, vehicle.position)

    def in_sight(car: RoadObject) -> bool:
        if (car.position - vehicle.position) @ vehicle.direction <= 0:
            return distance(car) < BEHIND_SIGHT
        oncoming = isinstance(car, Vehicle) and car.direction @ vehicle.direction < ONCOMING_COSINE
        return distance(car) < (ONCOMING if oncoming else AHEAD)

    return sorted(filter(in_sight, others), key=distance)[:MAX_VEHICLES]


def _ways(car: RoadObject, number: int, roads: RoadMap, intentions: bool) -> list[Way]:
    """Return the paths that a vehicle may take, given its position, heading and lane.

    If its route is known, these are the paths that share most of its roads with the route.
    """
    found, own, drives = [], roads.lanes[car.lane_index], isinstance(car, Vehicle) and not car.crashed
    seen = number, car.position, (car.LENGTH, car.WIDTH), drives
    if not getattr(car, "follows_lanes", True):  # such as a pedestrian, who goes straight on
        x, y = car.position[:, None] + (LINE - BEHIND) * np.array([[np.cos(car.heading)], [np.sin(car.heading)]])
        path = Curve(*np.stack([x, y, np.full_like(x, car.heading), 0 * x]).astype(np.float32))
        return [Way(*seen, path, (0.0, 0.0, 0.0, car.speed), max(car.speed, MIN_SPEED))]
    for lane in _begun(car, own) if drives else [own]:
        place = float(lane.shape.local_coordinates(car.position)[0])
        chains = _chains_from(lane, int(max(lane.length - place, 0.0) // TENS))
        found += [(rank, place, chain) for rank, chain in enumerate(chains)]
    legs = {leg[:2] for leg in (intentions and getattr(car, "route", None)) or ()}
    shared = [sum(lane.index[:2] in legs for lane in chain.lanes) for *_, chain in found]
    found = [item for item, roads_shared in zip(found, shared, strict=True) if roads_shared == max(shared)]
    found.sort(key=lambda item: item[0])
    ways = []
    for _, place, chain in found[: MAX_WAYS if drives else 1]:
        curve = chain.curve(place // BLOCK)
        s, d, heading = curve.project(car.position, car.heading, place)
        state = 0.0, d, heading, car.speed
        ways.append(Way(*seen, curve.path(s, TRAFFIC_KNOTS), state, chain.lanes[0].limit))
    return ways


def _begun(car: Vehicle, own: Lane) -> list[Lane]:
    """Return the lanes that a vehicle may be following.

    These are its own lane, all lanes from the same node as long as its position and heading fit them, the neighbour to
    which it moves within a second, and the neighbour of a lane that ends.
    """
    place, aside = own.shape.local_coordinates(car.position)
    found = [own]
    for end, lanes in own.roads.graph[own.start].items():
        if end != own.end:
            other = own.roads.lanes[own.start, end, min(own.number, len(lanes) - 1)]
            s, d = other.shape.local_coordinates(car.position)
            turned = wrapped(car.heading - other.shape.heading_at(s))
            if s >= -1.0 and abs(d) < max(ON_LANE, abs(aside)) and abs(turned) < ALONG:
                found.append(other)
    drift = aside + car.speed * sin(wrapped(car.heading - own.shape.heading_at(place)))
    changes = abs(drift) > own.shape.width_at(place) / 2
    neighbour = own.beside(1 if drift > 0 else -1) if changes else own.refuge
    return [*found, neighbour] if neighbour else found


@kept
def _chains_from(lane: Lane, tens: int) -> list[Chain]:
    """Return the chains of lanes from some tens of metres before a lane's end on, one for each branch."""
    found: list[Chain] = []
    open_ends: list[tuple[Lanes, float]] = [((lane,), TENS * tens)]
    for lanes, covered in open_ends:
        nexts = lanes[-1].following(CROOKED) if covered < PATH_LENGTH else ()
        onward = nexts if covered < BRANCHING_DISTANCE else nexts[:1]
        open_ends += [((*lanes, following), covered + following.length) for following in onward]
        if not nexts:
            found.append(lane.roads.chain(lanes))
    return found


def _leaders_of(paths: Curve, cars: Points, owners: Places) -> tuple[Places, Row]:
    """Return the index of the path of the car ahead on each path, -1 without one, and the distance to this car.

    Of the paths of the car ahead, the index is that of the first.
    """
    s, d, _ = paths.project(cars[:, 0], cars[:, 1], 0.0)  # [paths, cars]
    others = (owners[:, None] != owners) & (owners >= 0)
    nearest, leads = nearest_ahead(s, others & (np.abs(d) < IN_FRONT) & (s < LEADER_AHEAD))
    gaps = np.where(leads, s[np.arange(TRAFFIC), nearest], 0.0)
    return np.where(leads, nearest, -1).astype(np.int32), gaps.astype(np.float32)
