"""Find the ways that other vehicles may take, and who follows whom and who gives way on them."""

from dataclasses import dataclass
from itertools import count as counter
from itertools import pairwise
from math import sin
from weakref import WeakKeyDictionary

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject
from jaxtyping import Bool, Float, Int

from ms_highway.game.road import BEHIND, SPACING, TRAFFIC, TRAFFIC_KNOTS, Path, wrapped
from ms_highway.vehicle.road_map import LIMIT, Chain, LaneIndex, RoadMap

__all__ = ["Traffic", "Way", "traffic_of"]

AHEAD, BEHIND_SIGHT = 120.0, 60.0  # m, in which others are seen
MOST_VEHICLES, MOST_WAYS = 16, 3
BRANCHES = 60.0  # m ahead, up to which all ways are told apart
LENGTH = 140.0  # m, of ways
CROOKED = 0.8  # widths of a lane: others take joints, such as exits from inner lanes, that the robot does not
ON_LANE, ALONG = 1.0, 0.3  # m aside and rad, up to which a vehicle may follow a lane that begins where its own does
NEAR_ROUTE, CROSSING = 6.0, 3.0  # m between ways, up to which others matter, and conflict
IN_FRONT, LEADER_AHEAD = 1.5, 100.0  # m aside and ahead, in which a vehicle leads another
JOINED = 5.0  # m after a joint, up to which a vehicle still has the right of way there
NO_GAP = 1e3  # m, without a leader
FAR = -1e4  # m, coordinates of unused paths
EVERY = 2  # knots, compared


@dataclass(frozen=True)
class Way:
    """A way that a vehicle may take: lanes that follow each other, and the place on the first one [m]."""

    car: RoadObject
    owner: int
    chain: Chain
    place: float


@dataclass(frozen=True)
class Traffic:
    """The fields of a ``RoadScene`` that tell of others."""

    paths: Path
    states: Float[np.ndarray, "traffic 4"]
    sizes: Float[np.ndarray, "traffic 2"]
    present: Bool[np.ndarray, "traffic"]
    limits: Float[np.ndarray, "traffic"]
    leaders: Int[np.ndarray, "traffic"]
    gaps: Float[np.ndarray, "traffic"]
    owners: Int[np.ndarray, "traffic"]
    names: Int[np.ndarray, "traffic"]
    moving: Bool[np.ndarray, "traffic"]
    priority: Bool[np.ndarray, "traffic"]


def traffic_of(vehicle: Vehicle, roads: RoadMap, route: Path, chain: Chain, way: float) -> Traffic:
    """Return the paths of others around a vehicle, those that come near its route first, then by distance.

    Args:
        vehicle: the robot.
        roads: of its network.
        route: its path.
        chain: lanes of its path.
        way: at which it is along them [m].
    """
    ways = [way for number, car in enumerate(_seen(vehicle)) for way in _ways(car, number, roads)]
    drawn = [_draw(way, roads) for way in ways]
    conflicts = [_conflict(path, route) for path, _ in drawn]
    order = sorted(range(len(ways)), key=lambda number: (conflicts[number] is None, ways[number].owner))[:TRAFFIC]
    count, unused = len(order), TRAFFIC - len(order)
    line = SPACING * np.arange(TRAFFIC_KNOTS, dtype=np.float32)
    nowhere = Path(line + np.float32(FAR), np.full_like(line, FAR), np.zeros_like(line), np.zeros_like(line))
    paths = [drawn[number][0] for number in order] + [nowhere] * unused
    cars = [ways[number].car for number in order]
    owners = np.array([ways[number].owner for number in order] + [-1] * unused, dtype=np.int32)
    present = np.arange(TRAFFIC) < count
    stacked = Path(*(np.stack([getattr(path, name) for path in paths]) for name in ("x", "y", "heading", "curvature")))
    leaders, gaps = _leaders(stacked, cars, owners)
    priority = [
        _gives_way(roads, chain, way, ways[number], conflicts[number]) and _drives(ways[number].car) for number in order
    ]
    return Traffic(
        paths=stacked,
        states=np.array([drawn[number][1] for number in order] + [(0.0,) * 4] * unused, dtype=np.float32),
        sizes=np.array([(car.LENGTH, car.WIDTH) for car in cars] + [(5.0, 2.0)] * unused, dtype=np.float32),
        present=present,
        limits=np.array([roads.limit(ways[number].chain[0]) for number in order] + [LIMIT] * unused, dtype=np.float32),
        leaders=leaders,
        gaps=gaps,
        owners=owners,
        names=np.array([_name(car) for car in cars] + [-1] * unused, dtype=np.int32),
        moving=np.array([_drives(car) for car in cars] + [False] * unused),
        priority=np.array(priority + [False] * unused),
    )


def _seen(vehicle: Vehicle) -> list[RoadObject]:
    """Return vehicles and solid objects in sight, nearest first."""
    others = [car for car in vehicle.road.vehicles if car is not vehicle]
    others += [item for item in vehicle.road.objects if not isinstance(item, Landmark)]
    if not others:
        return []
    delta = np.array([car.position for car in others]) - vehicle.position
    distances = np.hypot(delta[:, 0], delta[:, 1])
    in_sight = distances < np.where(delta @ vehicle.direction > 0, AHEAD, BEHIND_SIGHT)
    nearest = [number for number in np.argsort(distances, kind="stable") if in_sight[number]]
    return [others[number] for number in nearest[:MOST_VEHICLES]]


_names: WeakKeyDictionary[RoadObject, int] = WeakKeyDictionary()
_unused_names = counter()


def _name(car: RoadObject) -> int:
    """Return a number that belongs to a vehicle as long as it lives."""
    if car not in _names:
        _names[car] = next(_unused_names)
    return _names[car]


def _drives(car: RoadObject) -> bool:
    """Return whether something may drive on; what has crashed slides to a stop."""
    return isinstance(car, Vehicle) and not car.crashed


def _ways(car: RoadObject, owner: int, roads: RoadMap) -> list[Way]:
    """Return the ways that a vehicle may take, as far as they can be told from its position, heading and lane."""
    found = []
    for index in _begun(car, roads) if _drives(car) else [car.lane_index]:
        place = float(roads.lanes[index].local_coordinates(car.position)[0])
        for number, chain in enumerate(_chains(roads, index, place)):
            found.append((number, Way(car, owner, chain, place)))
    found.sort(key=lambda item: item[0])
    return [way for _, way in found[: MOST_WAYS if _drives(car) else 1]]


def _begun(car: Vehicle, roads: RoadMap) -> list[LaneIndex]:
    """Return the lanes that a vehicle may be following.

    These are its lane; those that begin at the same node, as long as it cannot be told apart which one it takes; the
    neighbour that it moves to within a second, and that beside a lane that ends.
    """
    index = car.lane_index
    lane, found = roads.lanes[index], [index]
    place, aside = lane.local_coordinates(car.position)
    for end, lanes in roads.graph[index[0]].items():
        other = (index[0], end, min(index[2], len(lanes) - 1))
        if end != index[1]:
            s, d = roads.lanes[other].local_coordinates(car.position)
            turned = wrapped(car.heading - roads.lanes[other].heading_at(s))
            if s >= -1.0 and abs(d) < max(ON_LANE, abs(aside)) and abs(turned) < ALONG:
                found.append(other)
    drift = aside + car.speed * sin(wrapped(car.heading - lane.heading_at(place)))
    if abs(drift) > lane.width_at(place) / 2:
        neighbour = roads.beside(index, 1 if drift > 0 else -1)
    else:
        neighbour = roads.refuge(index)
    return [*found, neighbour] if neighbour else found


def _chains(roads: RoadMap, index: LaneIndex, place: float) -> tuple[Chain, ...]:
    """Return the chains of lanes from a place on a lane on, one for each way within `BRANCHES`."""
    tens = int(max(roads.lanes[index].length - place, 0.0) // 10)
    key = ("chains", index, tens)
    if key not in roads.kept:
        found: list[Chain] = []
        open_ends: list[tuple[Chain, float]] = [((index,), 10.0 * tens)]
        while open_ends:
            chain, covered = open_ends.pop(0)
            nexts = roads.following(chain[-1], CROOKED) if covered < LENGTH else ()
            if not nexts:
                found.append(chain)
            for following in nexts if covered < BRANCHES else nexts[:1]:
                open_ends.append(((*chain, following), covered + float(roads.lanes[following].length)))
        roads.kept[key] = tuple(found)
    return roads.kept[key]  # type: ignore[return-value]


def _draw(way: Way, roads: RoadMap) -> tuple[Path, tuple[float, float, float, float]]:
    """Return the path of a way and the vehicle's state on it."""
    curve = roads.curve(way.chain, way.place)
    s, d, heading = curve.project(way.car.position, way.car.heading, way.place)
    return curve.path(s, TRAFFIC_KNOTS), (0.0, d, heading, float(way.car.speed))


def _conflict(path: Path, route: Path) -> tuple[float, float, float] | None:
    """Return distances along a path and along the route to where they first come near, and how near; None if never.

    Oncoming traffic that keeps to its own lane does not come near.
    """
    ahead = slice(int(BEHIND / SPACING) - 2, None, EVERY)
    x = path.x[ahead, None] - route.x[None, ahead]
    y = path.y[ahead, None] - route.y[None, ahead]
    distances = np.hypot(x, y)
    oncoming = np.cos(path.heading[ahead, None] - route.heading[None, ahead]) < 0
    crossing = (distances < CROSSING).any(axis=1)
    near = crossing | ((distances < NEAR_ROUTE) & ~oncoming).any(axis=1)
    if not near.any():
        return None
    first = int(np.argmax(crossing)) if crossing.any() else int(np.argmax(near))
    on_route = int(np.argmin(distances[first]))
    return first * EVERY * SPACING, on_route * EVERY * SPACING, float(distances[first, on_route])


def _gives_way(roads: RoadMap, chain: Chain, at: float, way: Way, conflict: tuple[float, float, float] | None) -> bool:
    """Return whether the robot, at a way along a chain of lanes, has to give way to a vehicle.

    It has to

    * where their ways come within 3 m and the lowest ``priority`` of the vehicle's lanes from here to there is higher
      than that of the robot's lanes;
    * with equal priorities, where their ways join in a lane that another lane than the robot's continues into more
      evenly, such as the ring of a roundabout from its entry, and the vehicle comes from there.
    """
    if conflict is None or conflict[2] > CROSSING:
        return False
    until = roads.leg(way.chain, way.place + conflict[0])
    here, mine_until = roads.leg(chain, at), roads.leg(chain, at + conflict[1])
    theirs = min(_priority(roads, index) for index in way.chain[: until + 1])
    mine = min(_priority(roads, index) for index in chain[here : mine_until + 1])
    if theirs != mine:
        return theirs > mine
    meeting = way.chain[: until + 2]
    for before, lane in pairwise(chain[here:]):
        if lane in meeting:
            if roads.continues_best(before, lane):
                return False
            place = meeting.index(lane)
            return way.place < JOINED if place == 0 else roads.continues_best(meeting[place - 1], lane)
    return False


def _priority(roads: RoadMap, index: LaneIndex) -> int:
    return getattr(roads.lanes[index], "priority", 0)


def _leaders(
    paths: Path, cars: list[RoadObject], owners: Int[np.ndarray, "traffic"]
) -> tuple[Int[np.ndarray, "traffic"], Float[np.ndarray, "traffic"]]:
    """Return the place of the car ahead on each path, -1 without one, and the distance to it."""
    leaders, gaps = np.full(TRAFFIC, -1, dtype=np.int32), np.full(TRAFFIC, NO_GAP, dtype=np.float32)
    if not cars:
        return leaders, gaps
    count = len(cars)
    positions = np.array([car.position for car in cars])  # [cars, 2]
    x = positions[None, :, None, 0] - paths.x[:count, None, :]  # [paths, cars, knots]
    y = positions[None, :, None, 1] - paths.y[:count, None, :]
    nearest = np.argmin(x**2 + y**2, axis=-1)
    rows, columns = np.arange(count)[:, None], np.arange(count)[None, :]
    x, y, heading = x[rows, columns, nearest], y[rows, columns, nearest], paths.heading[rows, nearest]
    s = SPACING * nearest - BEHIND + np.cos(heading) * x + np.sin(heading) * y
    d = np.cos(heading) * y - np.sin(heading) * x
    other = owners[:count, None] != owners[None, :count]
    ahead = other & (np.abs(d) < IN_FRONT) & (s > 0) & (s < LEADER_AHEAD)
    distance = np.where(ahead, s, NO_GAP)
    leader = np.argmin(distance, axis=1)  # the first path of a car comes before its others
    found = ahead.any(axis=1)
    leaders[:count] = np.where(found, leader, -1)
    gaps[:count] = distance[np.arange(count), leader]
    return leaders, gaps
