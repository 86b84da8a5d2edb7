"""Find the paths that other vehicles may take, and the car ahead on each of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, dist, sin
from operator import attrgetter, itemgetter
from typing import NamedTuple, TypedDict

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


class PossiblePath(NamedTuple):
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


class Branch(NamedTuple):
    """Lanes that a vehicle may follow from where it is.

    Attributes:
        rank: among the branches from the same lane, smoothest first.
        place: of the vehicle along these lanes [m].
        chain: these lanes.
    """

    rank: int
    place: float
    chain: Chain


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
    in_sight = _in_sight(vehicle)
    possible = _possible_paths(in_sight, numbers, roads, intentions)
    used_paths = possible[: SHAPE.paths]
    used = len(used_paths)
    cars = [path.car for path in used_paths]

    # What is known without a path. Unused paths are far away, with any size.
    far = -1e4  # m
    owners = np.full(SHAPE.paths, -1, np.int32)
    moving = np.zeros(SHAPE.paths, dtype=bool)
    positions = np.full((SHAPE.paths, 2), far)
    sizes = np.full((SHAPE.paths, 2), (5.0, 2.0), np.float32)
    limits = np.full(SHAPE.paths, Lane.default_speed_limit, np.float32)
    states = np.zeros((SHAPE.paths, 4), np.float32)
    owners[:used] = [path.owner for path in used_paths]
    moving[:used] = [path.moves for path in used_paths]
    for number, car in enumerate(cars):
        positions[number] = car.position
        sizes[number] = (car.LENGTH, car.WIDTH)
        states[number, 3] = car.speed

    # The paths: x, y, heading and curvature at their knots, [4, paths, knots].
    along = SPACING * np.arange(SHAPE.path_knots, dtype=np.float32)
    zero = np.zeros_like(along)
    unused = np.array([along + np.float32(far), np.full_like(along, far), zero, zero])
    knots = np.repeat(unused[:, None], SHAPE.paths, axis=1)
    _follow_lanes(used_paths, roads, positions, knots, states, limits)
    _go_straight_on(used_paths, along - BEHIND, knots, limits)

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
    used_paths: list[PossiblePath],
    roads: RoadMap,
    positions: Points,
    knots: np.ndarray,
    states: np.ndarray,
    limits: np.ndarray,
) -> None:
    """Fill in the paths along lanes.

    Also fill in the places, headings and speed limits of the vehicles there.

    Args:
        used_paths: of all vehicles.
        roads: map of the network.
        positions: of the vehicles, by path.
        knots: of all paths, [4, paths, knots], filled in.
        states: of the vehicles on their paths, filled in.
        limits: speed limits, filled in.
    """
    numbers: list[int] = []
    spots: list[tuple[Chain, float]] = []
    headings: list[float] = []
    for number, path in enumerate(used_paths):
        if path.chain:
            numbers.append(number)
            spots.append((path.chain, path.place))
            headings.append(path.car.heading)
    if not spots:
        return

    curves = roads.curves(spots)
    own_positions = positions[numbers]
    own_headings = np.array(headings, dtype=float)
    places = np.array([place for _, place in spots])
    s, d, relative_heading = project_cars(curves, own_positions, own_headings, places)
    ahead = paths_from(curves, s, SHAPE.path_knots)
    knots[:, numbers] = ahead.x, ahead.y, ahead.heading, ahead.curvature
    states[numbers, 1] = d
    states[numbers, 2] = relative_heading
    limits[numbers] = [chain.lanes[0].limit for chain, _ in spots]


def _go_straight_on(
    used_paths: list[PossiblePath],
    along: Row,
    knots: np.ndarray,
    limits: np.ndarray,
) -> None:
    """Fill in the paths and speed limits of those that follow no lane.

    Pedestrians are such.

    Args:
        used_paths: of all vehicles.
        along: positions of the knots along a path [m].
        knots: of all paths, [4, paths, knots], filled in.
        limits: speed limits, filled in.
    """
    for number, path in enumerate(used_paths):
        if path.chain is not None:
            continue
        x, y = path.car.position
        heading = path.car.heading
        knots[0, number] = x + along * np.cos(heading)
        knots[1, number] = y + along * np.sin(heading)
        knots[2, number] = heading
        knots[3, number] = 0.0
        limits[number] = max(path.car.speed, LANE_CHOICE.least_limit)


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
    ahead = (car.position - vehicle.position) @ vehicle.direction
    if ahead <= 0:
        return SIGHT.behind
    if not isinstance(car, Vehicle):
        return SIGHT.ahead
    cosine = car.direction @ vehicle.direction
    is_oncoming = cosine < SIGHT.oncoming_cosine
    return SIGHT.oncoming if is_oncoming else SIGHT.ahead


def _possible_paths(
    cars: list[RoadObject],
    numbers: dict[RoadObject, int],
    roads: RoadMap,
    intentions: bool,
) -> list[PossiblePath]:
    """Return the paths that each vehicle may take.

    They follow from its position, heading and lane. If its route is known, these are
    the paths that share most of its roads with the route.
    """
    found = []
    for car in cars:
        number = numbers.setdefault(car, len(numbers))
        drives = isinstance(car, Vehicle) and not car.crashed
        branches = _branches(car, drives, roads)
        if not branches:  # such as a pedestrian
            found.append(PossiblePath(number, car, drives, None, 0.0))
            continue

        # The smoothest branches.
        if intentions:
            branches = _along_route(branches, getattr(car, "route", None) or ())
        branches.sort(key=attrgetter("rank"))
        most = SIGHT.paths_of_vehicle if drives else 1
        for branch in branches[:most]:
            path = PossiblePath(number, car, drives, branch.chain, branch.place)
            found.append(path)
    return found


def _branches(car: RoadObject, drives: bool, roads: RoadMap) -> list[Branch]:
    """Return the branches that a vehicle may follow, none if it follows no lanes."""
    if not getattr(car, "follows_lanes", True):
        return []
    own = roads.lanes[car.lane_index]
    lanes = _possible_lanes(car, own) if drives else [own]

    # Where the vehicle is on each of the lanes.
    spots: list[tuple[Lane, float]] = []
    for lane in lanes:
        place, _ = lane.shape.local_coordinates(car.position)
        spots.append((lane, float(place)))

    found = []
    for (_, place), chains in zip(spots, roads.branches(spots), strict=True):
        for rank, chain in enumerate(chains):
            found.append(Branch(rank, place, chain))
    return found


def _along_route(branches: list[Branch], route: Sequence[LaneIndex]) -> list[Branch]:
    """Return the branches that share most of their roads with a route."""
    roads = {index[:2] for index in route}

    def shared(branch: Branch) -> int:
        """Return how many of the branch's lanes are on roads of the route."""
        return sum(index[:2] in roads for index in branch.chain.indices)

    most = max(map(shared, branches))
    return [branch for branch in branches if shared(branch) == most]


def _possible_lanes(car: Vehicle, own: Lane) -> list[Lane]:
    """Return the lanes that a vehicle may be following.

    These are its own lane, all lanes from the same node as long as its position and
    heading fit them, the neighbour to which it moves within a second, and the neighbour
    of a lane that ends.
    """
    place, aside = own.shape.local_coordinates(car.position)
    found = [own]
    for end, lanes in own.roads.graph[own.start].items():
        if end == own.end:
            continue
        number = min(own.number, len(lanes) - 1)
        other = own.roads.lanes[own.start, end, number]
        s, d = other.shape.local_coordinates(car.position)
        cosine = cos(car.heading - other.shape.heading_at(s))
        has_begun = s >= -LANE_CHOICE.begins_ahead
        is_near = abs(d) < max(LANE_CHOICE.distance, abs(aside))
        if has_begun and is_near and cosine > LANE_CHOICE.cosine:
            found.append(other)

    # Where it will be in a second, across its own lane.
    relative_heading = car.heading - own.shape.heading_at(place)
    later = aside + car.speed * sin(relative_heading)
    changes_lane = abs(later) > own.shape.width_at(place) / 2
    side = 1 if later > 0 else -1
    beside = own.beside(side) if changes_lane else own.refuge
    if beside:
        found.append(beside)
    return found


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
