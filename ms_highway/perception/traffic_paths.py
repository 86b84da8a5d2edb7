"""Find the ways that other vehicles may take, and who follows whom on them."""

from math import sin
from typing import Any, NamedTuple

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject

from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.geometry.curve import BEHIND, SPACING, Curve, wrapped
from ms_highway.geometry.lane_paths import Points, Row
from ms_highway.geometry.road_map import BLOCK, LIMIT, Chain, Lane, Lanes, RoadMap, kept
from ms_highway.perception.scene import TRAFFIC, TRAFFIC_KNOTS, Places
from ms_highway.runtime.arrays import Car

AHEAD, ONCOMING, BEHIND_SIGHT = 120.0, 250.0, 60.0  # m, in which others are seen ahead, coming, and behind
MAX_VEHICLES, MAX_WAYS = 16, 3
BRANCHING_DISTANCE = 60.0  # m ahead, up to which all ways are told apart
ONCOMING_COSINE = -0.7  # cosine of the angle between headings of those who come
PATH_LENGTH = 140.0  # m, of ways
TENS = 10.0  # m, in steps of which the rest of a lane is counted
CROOKED = 0.8  # widths of a lane: others take joints, such as exits from inner lanes, that the robot does not
ON_LANE, ALONG = 1.0, 0.3  # m aside and rad, up to which a vehicle may follow a lane that begins where its own does
IN_FRONT, LEADER_AHEAD = 1.5, 100.0  # m aside and ahead, in which a vehicle leads another
MIN_SPEED = 0.1  # m/s, of what may move
FAR = -1e4  # m, coordinates of unused paths
LINE = SPACING * np.arange(TRAFFIC_KNOTS, dtype=np.float32)
AWAY = np.stack([LINE + np.float32(FAR), np.full_like(LINE, FAR), 0 * LINE, 0 * LINE])
"""An unused path: its x, y, heading and curvature."""


class Way(NamedTuple):
    """A way that a vehicle may take.

    Attributes:
        car: the vehicle, or an obstacle.
        path: along its lanes.
        state: of the vehicle on the path.
        limit: of its speed [m/s].
    """

    car: RoadObject
    path: Curve
    state: Car
    limit: float


def traffic_of(
    vehicle: Vehicle, roads: RoadMap, numbers: dict[RoadObject, int], intentions: bool = False
) -> dict[str, Any]:
    """Return what a ``RoadScene`` has of others, nearest first.

    Args:
        vehicle: the robot.
        roads: of its network.
        numbers: of all vehicles seen so far; those seen first now are added.
        intentions: whether others show which way they take.
    """
    seen = _in_sight(vehicle)
    for car in seen:
        numbers.setdefault(car, len(numbers))
    ways = [way for car in seen for way in _ways(car, roads, intentions)][:TRAFFIC]
    owners = _padded([numbers[way.car] for way in ways], -1, np.int32)
    fields = [(way.path.x, way.path.y, way.path.heading, way.path.curvature) for way in ways]
    paths = Curve(*_padded(fields, AWAY).swapaxes(0, 1))
    leaders, gaps = _leaders_of(paths, _padded([way.car.position for way in ways], (FAR, FAR), float), owners)
    return {
        "paths": paths,
        "states": _padded([way.state for way in ways], np.zeros(4)),
        "sizes": _padded([(way.car.LENGTH, way.car.WIDTH) for way in ways], (5.0, 2.0)),
        "present": owners >= 0,
        "limits": _padded([way.limit for way in ways], LIMIT),
        "owners": owners,
        "moving": _padded([_drives(way.car) for way in ways], False, bool),
        "leaders": leaders,
        "gaps": gaps,
        "accelerations": np.zeros(TRAFFIC, np.float32),
    }


def _padded(rows: list[Any], absent: Any, kind: type = np.float32) -> Any:
    """Return an array of `TRAFFIC` rows, those after the given ones absent."""
    return np.array([*rows, *[absent] * (TRAFFIC - len(rows))], kind)


def _in_sight(vehicle: Vehicle) -> list[RoadObject]:
    """Return vehicles and solid objects in sight, nearest first."""
    others = [car for car in vehicle.road.vehicles if car is not vehicle]
    others += [item for item in vehicle.road.objects if not isinstance(item, Landmark)]
    delta = np.array([car.position for car in others]).reshape(-1, 2) - vehicle.position
    distances = np.hypot(delta[:, 0], delta[:, 1])
    comes = [isinstance(car, Vehicle) and car.direction @ vehicle.direction < ONCOMING_COSINE for car in others]
    ahead = np.where(comes, ONCOMING, AHEAD)
    seen = distances < np.where(delta @ vehicle.direction > 0, ahead, BEHIND_SIGHT)
    nearest = [number for number in np.argsort(distances, kind="stable") if seen[number]]
    return [others[number] for number in nearest[:MAX_VEHICLES]]


def _drives(car: RoadObject) -> bool:
    """Return whether something may drive on; what has crashed slides to a stop."""
    return isinstance(car, Vehicle) and not car.crashed


def _ways(car: RoadObject, roads: RoadMap, intentions: bool) -> list[Way]:
    """Return the ways that a vehicle may take, as far as they can be told from its position, heading and lane.

    Where it shows its intentions, these are the ways that have most of its route.
    """
    found, own = [], roads.lanes[car.lane_index]
    if not getattr(car, "follows_lanes", True):  # such as a pedestrian, who goes straight on
        x, y = car.position[:, None] + (LINE - BEHIND) * np.array([[np.cos(car.heading)], [np.sin(car.heading)]])
        path = Curve(*np.stack([x, y, np.full_like(x, car.heading), 0 * x]).astype(np.float32))
        return [Way(car, path, np.array([0.0, 0.0, 0.0, car.speed]), max(car.speed, MIN_SPEED))]
    for lane in _begun(car, own) if _drives(car) else [own]:
        place = float(lane.shape.local_coordinates(car.position)[0])
        chains = _chains_from(lane, int(max(lane.length - place, 0.0) // TENS))
        found += [(number, place, chain) for number, chain in enumerate(chains)]
    legs = {leg[:2] for leg in (intentions and getattr(car, "route", None)) or ()}
    shown = [sum(lane.index[:2] in legs for lane in chain.lanes) for *_, chain in found]
    found = [item for item, number in zip(found, shown, strict=True) if number == max(shown)]
    found.sort(key=lambda item: item[0])
    ways = []
    for _, place, chain in found[: MAX_WAYS if _drives(car) else 1]:
        curve = chain.curve(place // BLOCK)
        s, d, heading = curve.project(car.position, car.heading, place)
        path = curve.path(s, TRAFFIC_KNOTS)
        ways.append(Way(car, path, np.array([0.0, d, heading, car.speed]), chain.lanes[0].limit))
    return ways


def _begun(car: Vehicle, own: Lane) -> list[Lane]:
    """Return the lanes that a vehicle may be following.

    These are its lane; those that begin at the same node, as long as it cannot be told apart which one it takes; the
    neighbour that it moves to within a second, and that beside a lane that ends.
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
    """Return the chains of lanes from some tens of metres before a lane's end on, one for each way that branches."""
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
    """Return the place of the car ahead on each path, -1 without one, and the distance to it.

    The first path of a car comes before its others.
    """
    s, d, _ = paths.project(cars[:, 0], cars[:, 1], 0.0)  # [paths, cars]
    others = (owners[:, None] != owners) & (owners >= 0)
    nearest, leads = nearest_ahead(s, others & (np.abs(d) < IN_FRONT) & (s < LEADER_AHEAD))
    gaps = np.where(leads, s[np.arange(TRAFFIC), nearest], 0.0)
    return np.where(leads, nearest, -1).astype(np.int32), gaps.astype(np.float32)
