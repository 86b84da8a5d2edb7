"""Find the paths that other vehicles may take, and the car ahead on each of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, dist, sin
from operator import itemgetter
from typing import NamedTuple, TypeAlias, TypedDict

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject

from ms_highway.geometry.bodies import Sizes, nearest_ahead
from ms_highway.geometry.curve import BEHIND, SPACING, Curve
from ms_highway.geometry.lane_paths import Points, Row, paths_from, project_cars
from ms_highway.geometry.road_map import Chain, Lane, RoadMap
from ms_highway.perception.scene import SHAPE, Flags, Places, Traffic
from ms_highway.runtime.arrays import State


@dataclass(frozen=True)
class Sight:
    """Set how far the robot sees, and how many others it predicts."""

    ahead: float = 120.0
    """Distance ahead [m]."""
    oncoming: float = 250.0
    """Distance ahead for oncoming vehicles, which are met at both speeds [m]."""
    behind: float = 60.0
    """Distance behind [m]."""
    vehicles: int = 16
    """Largest number of vehicles and obstacles, the nearest ones."""
    paths_of_vehicle: int = 3
    """Largest number of paths of a vehicle, the smoothest ones."""
    oncoming_cosine: float = -0.7
    """Cosine of the angle between headings below which a vehicle is oncoming."""


SIGHT = Sight()


@dataclass(frozen=True)
class LaneChoice:
    """Set which lanes a vehicle may be following, and whom it follows."""

    distance: float = 1.0
    """Distance to the middle of a lane that begins where the vehicle's own does, up to
    which it may follow that lane [m].
    """
    begins_ahead: float = 1.0
    """Distance ahead at which such a lane may begin [m]."""
    cosine: float = cos(0.3)
    """Cosine of the angle to such a lane above which the vehicle may follow it."""
    leader_aside: float = 1.5
    """Lateral distance up to which a vehicle leads another one [m]."""
    leader_ahead: float = 100.0
    """Longitudinal distance up to which a vehicle leads another one [m]."""
    least_limit: float = 0.1
    """Lowest speed limit of pedestrians [m/s]."""


LANE_CHOICE = LaneChoice()


class TrafficFields(TypedDict):
    """The fields of a ``RoadScene`` that describe others."""

    paths: Curve
    states: State
    sizes: Sizes
    limits: Traffic
    owners: Places
    moving: Flags
    leaders: Places
    gaps: Traffic
    accelerations: Traffic


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
    car: RoadObject
    moves: bool
    chain: Chain | None
    place: float


Option: TypeAlias = tuple[int, float, Chain]
"""The rank of a branch, smoothest first, the place where it begins along its lanes [m],
and its lanes.
"""


def traffic_of(
    vehicle: Vehicle,
    roads: RoadMap,
    numbers: dict[RoadObject, int],
    intentions: bool,
) -> TrafficFields:
    """Return the fields of a ``RoadScene`` that describe others, nearest first.

    Args:
        vehicle: the robot.
        roads: map of its network.
        numbers: of all vehicles seen so far; new vehicles are added.
        intentions: whether the routes of others are known.
    """
    ways = _ways(_in_sight(vehicle), numbers, roads, intentions)[: SHAPE.paths]
    used = len(ways)
    cars = [way.car for way in ways]

    # What is known without a path. Unused paths are far away, with any size.
    far = -1e4  # m
    owners = np.full(SHAPE.paths, -1, np.int32)
    moving = np.zeros(SHAPE.paths, dtype=bool)
    positions = np.full((SHAPE.paths, 2), far)
    sizes = np.full((SHAPE.paths, 2), (5.0, 2.0), np.float32)
    limits = np.full(SHAPE.paths, Lane.default_speed_limit, np.float32)
    states = np.zeros((SHAPE.paths, 4), np.float32)
    owners[:used] = [way.owner for way in ways]
    moving[:used] = [way.moves for way in ways]
    positions[:used] = np.reshape([car.position for car in cars], (used, 2))
    sizes[:used] = np.reshape([(car.LENGTH, car.WIDTH) for car in cars], (used, 2))
    states[:used, 3] = [car.speed for car in cars]

    # The paths: x, y, heading and curvature at their knots, [4, paths, knots].
    along = SPACING * np.arange(SHAPE.path_knots, dtype=np.float32)
    unused = along + np.float32(far), np.full_like(along, far), 0 * along, 0 * along
    knots = np.repeat(np.array(unused)[:, None], SHAPE.paths, axis=1)
    _follow_lanes(ways, roads, positions, knots, states, limits)
    _go_straight_on(ways, along - BEHIND, knots, limits)

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
        "accelerations": np.zeros(SHAPE.paths, np.float32),
    }


def _follow_lanes(
    ways: list[Way],
    roads: RoadMap,
    positions: Points,
    knots: np.ndarray,
    states: np.ndarray,
    limits: np.ndarray,
) -> None:
    """Fill in the paths along lanes.

    Also fill in the places, headings and speed limits of the vehicles there.

    Args:
        ways: of all vehicles.
        roads: map of the network.
        positions: of the vehicles, by path.
        knots: of all paths, [4, paths, knots], filled in.
        states: of the vehicles on their paths, filled in.
        limits: speed limits, filled in.
    """
    numbers = [number for number, way in enumerate(ways) if way.chain]
    spots = [(way.chain, way.place) for way in ways if way.chain]
    if not spots:
        return
    curves = roads.curves(spots)
    headings = np.array([ways[number].car.heading for number in numbers], dtype=float)
    places = np.array([place for _, place in spots])
    s, d, relative = project_cars(curves, positions[numbers], headings, places)
    path = paths_from(curves, s, SHAPE.path_knots)
    knots[:, numbers] = path.x, path.y, path.heading, path.curvature
    states[numbers, 1] = d
    states[numbers, 2] = relative
    limits[numbers] = [chain.lanes[0].limit for chain, _ in spots]


def _go_straight_on(
    ways: list[Way],
    along: Row,
    knots: np.ndarray,
    limits: np.ndarray,
) -> None:
    """Fill in the paths and speed limits of those that follow no lane.

    Pedestrians are such.

    Args:
        ways: of all vehicles.
        along: positions of the knots along a path [m].
        knots: of all paths, [4, paths, knots], filled in.
        limits: speed limits, filled in.
    """
    for number, way in enumerate(ways):
        if way.chain is None:
            x, y = way.car.position
            heading = way.car.heading
            knots[0, number] = x + along * np.cos(heading)
            knots[1, number] = y + along * np.sin(heading)
            knots[2, number] = heading
            knots[3, number] = 0.0
            limits[number] = max(way.car.speed, LANE_CHOICE.least_limit)


def _in_sight(vehicle: Vehicle) -> list[RoadObject]:
    """Return vehicles and solid objects in sight, nearest first."""
    others = [car for car in vehicle.road.vehicles if car is not vehicle]
    others += [item for item in vehicle.road.objects if not isinstance(item, Landmark)]
    seen = []
    for car in others:
        distance = dist(car.position, vehicle.position)
        if distance < _range_of_sight(vehicle, car):
            seen.append((distance, car))
    seen.sort(key=itemgetter(0))
    return [car for _, car in seen[: SIGHT.vehicles]]


def _range_of_sight(vehicle: Vehicle, car: RoadObject) -> float:
    """Return the distance up to which a vehicle sees another one or an obstacle [m]."""
    if (car.position - vehicle.position) @ vehicle.direction <= 0:
        return SIGHT.behind
    if not isinstance(car, Vehicle):
        return SIGHT.ahead
    cosine = car.direction @ vehicle.direction
    return SIGHT.oncoming if cosine < SIGHT.oncoming_cosine else SIGHT.ahead


def _ways(
    cars: list[RoadObject],
    numbers: dict[RoadObject, int],
    roads: RoadMap,
    intentions: bool,
) -> list[Way]:
    """Return the paths that each vehicle may take.

    They follow from its position, heading and lane. If its route is known, these are
    the paths that share most of its roads with the route.
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
            for lane in _possible_lanes(car, own) if drives else [own]:
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
        most = SIGHT.paths_of_vehicle if drives else 1
        for _, place, chain in options[:most]:
            found.append(Way(number, car, drives, chain, place))
    return found


def _along_route(options: list[Option], route: Sequence[LaneIndex]) -> list[Option]:
    """Return the options that share most of their roads with a route."""
    roads = {index[:2] for index in route}

    def shared(option: Option) -> int:
        """Return how many of the option's lanes are on roads of the route."""
        _, _, chain = option
        return sum(index[:2] in roads for index in chain.indices)

    most = max(map(shared, options))
    return [option for option in options if shared(option) == most]


def _possible_lanes(car: Vehicle, own: Lane) -> list[Lane]:
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
            has_begun = s >= -LANE_CHOICE.begins_ahead
            is_near = abs(d) < max(LANE_CHOICE.distance, abs(aside))
            if has_begun and is_near and cosine > LANE_CHOICE.cosine:
                found.append(other)

    # Where it will be in a second, across its own lane.
    later = aside + car.speed * sin(car.heading - own.shape.heading_at(place))
    changes_lane = abs(later) > own.shape.width_at(place) / 2
    beside = own.beside(1 if later > 0 else -1) if changes_lane else own.refuge
    return [*found, beside] if beside else found


def _leaders_of(paths: Curve, cars: Points, owners: Places) -> tuple[Places, Row]:
    """Return the path of the car ahead on each path, and the distance to it [m].

    The index of a path is -1 without a car ahead. Of the paths of the car ahead, the
    index is that of the first.
    """
    s, d, _ = paths.project(cars[:, 0], cars[:, 1], 0.0)  # [paths, cars]
    is_other = (owners[:, None] != owners) & (owners >= 0)
    is_in_front = np.abs(d) < LANE_CHOICE.leader_aside
    may_lead = is_other & is_in_front & (s < LANE_CHOICE.leader_ahead)
    nearest, has_leader = nearest_ahead(s, may_lead)
    leaders = np.where(has_leader, nearest, -1)
    gaps = np.where(has_leader, s[np.arange(SHAPE.paths), nearest], 0.0)
    return leaders.astype(np.int32), gaps.astype(np.float32)
