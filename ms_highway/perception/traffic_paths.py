"""Find the paths that other vehicles may take, and the car ahead on each of them."""

from collections.abc import Sequence
from math import cos, dist, sin
from operator import itemgetter
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject

from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.geometry.curve import BEHIND, SPACING, Curve
from ms_highway.geometry.lane_paths import Points, Row, paths_from, project_cars
from ms_highway.geometry.road_map import LIMIT, Chain, Lane, RoadMap
from ms_highway.perception.scene import TRAFFIC, TRAFFIC_KNOTS, Places

AHEAD, ONCOMING, BEHIND_SIGHT = (
    120.0,
    250.0,
    60.0,
)  # m, range of sight: ahead, for oncoming vehicles, and behind
MAX_VEHICLES = 16
MAX_WAYS = 3
ONCOMING_COSINE = (
    -0.7
)  # cosine of the angle between headings below which a vehicle is oncoming
# m beside a lane that begins where the vehicle's own does, up to which it may follow
# that lane
ON_LANE = 1.0
ALONG_COSINE = cos(
    0.3
)  # cosine of the angle to such a lane, above which the vehicle may follow it
IN_FRONT, LEADER_AHEAD = (
    1.5,
    100.0,
)  # m, lateral and longitudinal distance up to which a vehicle leads another
MIN_SPEED = 0.1  # m/s, lowest speed limit of pedestrians
FAR = -1e4  # m, coordinates of unused paths
UNUSED_SIZE = (5.0, 2.0)  # m, length and width of what has no path
LINE = SPACING * np.arange(TRAFFIC_KNOTS, dtype=np.float32)


class Way(NamedTuple):
    """A path that a vehicle or an obstacle may take.

    Attributes:
        owner: number of the vehicle or obstacle.
        car: vehicle or obstacle.
        moves: whether it can move.
        chain: lanes that it follows; None for one that goes straight on, such as a
            pedestrian.
        place: its way along these lanes [m].
    """

    owner: int
    car: Any
    moves: bool
    chain: Chain | None
    place: float


Option: TypeAlias = tuple[int, float, Chain]
"""The rank of a branch, smoothest first, the place where it begins along its lanes [m],
and its lanes.
"""


def traffic_of(
    vehicle: Vehicle, roads: RoadMap, numbers: dict[RoadObject, int], intentions: bool
) -> dict[str, Any]:
    """Return the fields of a ``RoadScene`` that describe others, nearest first.

    Args:
        vehicle: the robot.
        roads: map of its network.
        numbers: of all vehicles seen so far; new vehicles are added.
        intentions: whether the routes of others are known.
    """
    ways = _ways(_in_sight(vehicle), numbers, roads, intentions)[:TRAFFIC]
    used = len(ways)
    cars = [way.car for way in ways]
    speeds = [car.speed for car in cars]

    # What is known without a path; unused paths are far away.
    owners = np.full(TRAFFIC, -1, np.int32)
    moving = np.zeros(TRAFFIC, dtype=bool)
    positions = np.full((TRAFFIC, 2), FAR)
    sizes = np.full((TRAFFIC, 2), UNUSED_SIZE, np.float32)
    limits = np.full(TRAFFIC, LIMIT, np.float32)
    states = np.zeros((TRAFFIC, 4), np.float32)
    owners[:used] = [way.owner for way in ways]
    moving[:used] = [way.moves for way in ways]
    positions[:used] = np.reshape([car.position for car in cars], (used, 2))
    sizes[:used] = np.reshape([(car.LENGTH, car.WIDTH) for car in cars], (used, 2))
    states[:used, 3] = speeds

    # Those on lanes: the curves along these, and the cars' places there.
    unused = LINE + np.float32(FAR), np.full_like(LINE, FAR), 0 * LINE, 0 * LINE
    knots = np.repeat(np.array(unused)[:, None], TRAFFIC, axis=1)  # [4, paths, knots]
    on_lanes = [place for place, way in enumerate(ways) if way.chain]
    spots = [(way.chain, way.place) for way in ways if way.chain]
    if spots:
        curves = roads.curves(spots)
        headings = np.array([cars[place].heading for place in on_lanes], dtype=float)
        along = np.array([way for _, way in spots])
        s, d, turned = project_cars(curves, positions[on_lanes], headings, along)
        path = paths_from(curves, s, TRAFFIC_KNOTS)
        knots[:, on_lanes] = path.x, path.y, path.heading, path.curvature
        states[on_lanes, 1] = d
        states[on_lanes, 2] = turned
        limits[on_lanes] = [chain.lanes[0].limit for chain, _ in spots]

    # Those that go straight on.
    for place, way in enumerate(ways):
        if way.chain is None:
            x, y = cars[place].position
            heading = cars[place].heading
            ahead = LINE - BEHIND
            knots[0, place] = x + ahead * np.cos(heading)
            knots[1, place] = y + ahead * np.sin(heading)
            knots[2, place] = heading
            knots[3, place] = 0.0
            limits[place] = max(speeds[place], MIN_SPEED)

    paths = Curve(*knots)
    leaders, gaps = _leaders_of(paths, positions, owners)
    return {
        "paths": paths,
        "states": states,
        "sizes": sizes,
        "limits": limits,
        "owners": owners,
        "moving": moving,
        "leaders": leaders,
        "gaps": gaps,
        "accelerations": np.zeros(TRAFFIC, np.float32),
    }


def _in_sight(vehicle: Vehicle) -> list[RoadObject]:
    """Return vehicles and solid objects in sight, nearest first."""
    others = [car for car in vehicle.road.vehicles if car is not vehicle]
    others += [item for item in vehicle.road.objects if not isinstance(item, Landmark)]
    seen = []
    for car in others:
        distance = dist(car.position, vehicle.position)
        if (car.position - vehicle.position) @ vehicle.direction <= 0:
            reach = BEHIND_SIGHT
        elif (
            isinstance(car, Vehicle)
            and car.direction @ vehicle.direction < ONCOMING_COSINE
        ):
            reach = ONCOMING
        else:
            reach = AHEAD
        if distance < reach:
            seen.append((distance, car))
    seen.sort(key=itemgetter(0))
    return [car for _, car in seen[:MAX_VEHICLES]]


def _ways(
    cars: list[RoadObject],
    numbers: dict[RoadObject, int],
    roads: RoadMap,
    intentions: bool,
) -> list[Way]:
    """Return the paths that each vehicle may take, given its position, heading and
    lane.

    If its route is known, these are the paths that share most of its roads with the
    route.
    """
    # Places on the lanes that each vehicle may be following; none for those that follow
    # no lanes.
    spots: list[tuple[Lane, float]] = []
    seen: list[tuple[RoadObject, bool, range]] = []
    for car in cars:
        drives = isinstance(car, Vehicle) and not car.crashed
        first = len(spots)
        if getattr(car, "follows_lanes", True):
            own = roads.lanes[car.lane_index]
            for lane in _begun(car, own) if drives else [own]:
                place, _ = lane.shape.local_coordinates(car.position)
                spots.append((lane, float(place)))
        seen.append((car, drives, range(first, len(spots))))
    branches = roads.branches(spots)

    # The smoothest branches of each vehicle.
    found = []
    for car, drives, own_spots in seen:
        number = numbers.setdefault(car, len(numbers))
        if not own_spots:  # such as a pedestrian
            found.append(Way(number, car, drives, None, 0.0))
            continue
        options: list[Option] = []
        for spot in own_spots:
            for rank, chain in enumerate(branches[spot]):
                options.append((rank, spots[spot][1], chain))
        if intentions:
            options = _along_route(options, getattr(car, "route", None) or ())
        options.sort(key=itemgetter(0))
        for _, place, chain in options[: MAX_WAYS if drives else 1]:
            found.append(Way(number, car, drives, chain, place))
    return found


def _along_route(options: list[Option], route: Sequence[LaneIndex]) -> list[Option]:
    """Return the options that share most of their roads with a route."""
    legs = {leg[:2] for leg in route}
    shared = [
        sum(index[:2] in legs for index in chain.indices) for *_, chain in options
    ]
    most = max(shared)
    return [
        option for option, count in zip(options, shared, strict=True) if count == most
    ]


def _begun(car: Vehicle, own: Lane) -> list[Lane]:
    """Return the lanes that a vehicle may be following.

    These are its own lane, all lanes from the same node as long as its position and
    heading fit them, the neighbour to which it moves within a second, and the neighbour
    of a lane that ends.
    """
    place, aside = own.shape.local_coordinates(car.position)
    found = [own]
    for end, lanes in own.roads.graph[own.start].items():
        if end != own.end:
            other = own.roads.lanes[own.start, end, min(own.number, len(lanes) - 1)]
            s, d = other.shape.local_coordinates(car.position)
            cosine = cos(car.heading - other.shape.heading_at(s))
            near = s >= -1.0 and abs(d) < max(ON_LANE, abs(aside))
            if near and cosine > ALONG_COSINE:
                found.append(other)
    drift = aside + car.speed * sin(car.heading - own.shape.heading_at(place))
    changes = abs(drift) > own.shape.width_at(place) / 2
    neighbour = own.beside(1 if drift > 0 else -1) if changes else own.refuge
    return [*found, neighbour] if neighbour else found


def _leaders_of(paths: Curve, cars: Points, owners: Places) -> tuple[Places, Row]:
    """Return the index of the path of the car ahead on each path, -1 without one, and
    the distance to this car.

    Of the paths of the car ahead, the index is that of the first.
    """
    s, d, _ = paths.project(cars[:, 0], cars[:, 1], 0.0)  # [paths, cars]
    others = (owners[:, None] != owners) & (owners >= 0)
    nearest, leads = nearest_ahead(
        s, others & (np.abs(d) < IN_FRONT) & (s < LEADER_AHEAD)
    )
    gaps = np.where(leads, s[np.arange(TRAFFIC), nearest], 0.0)
    return np.where(leads, nearest, -1).astype(np.int32), gaps.astype(np.float32)
