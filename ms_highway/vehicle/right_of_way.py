"""Decide who goes first where the ways of vehicles cross or meet, and how hard the others have to brake for it.

Ways are known, as drivers show them by indicators: every vehicle follows its lane and then its route, like
highway-env's. Vehicles that stay on one road are not in conflict: behind each other they follow, and beside each other
they change lanes, both of which is decided elsewhere.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from scipy.spatial import cKDTree

from ms_highway.geometry.lane_paths import Points, Row
from ms_highway.geometry.road_map import Lane, Lanes, RoadMap, kept, road_map
from ms_highway.runtime.arrays import Numbers

SPACING = 1.5
"""Distance between the points of a way [m]."""

MERGING = 6.0
"""Distance in which a vehicle that goes to another lane has covered all but a third of the way aside [m]."""


@dataclass(frozen=True)
class GapAcceptance:
    """What drivers keep to where ways meet.

    Attributes:
        reach: distance along the own way within which conflicts count [m]; more than it takes to stop from 20 m/s.
        crossed: widths of a lane that drivers cross at most where their lane ends.
        clearance: distance of two ways below which vehicles on them would touch [m]: a width, and room for steering.
        stop: distance from a conflict at which drivers wait for it to be free [m].
        time: between one vehicle leaving a conflict and the other one entering it [s].
        headway: time by which a driver enters a lane ahead of a vehicle that has the right of way [s].
        starting: acceleration with which a driver expects to enter a gap [m/s^2].
        comfortable: deceleration that a driver imposes on a vehicle with the right of way at most [m/s^2].
        calm: deceleration up to which drivers do not brake yet before a conflict [m/s^2].
        holding: deceleration per speed of a driver who waits, so that no step ends backwards [1/s].
        firm: deceleration above which a vehicle is expected not to stop any more [m/s^2].
    """

    reach: float = 60.0
    crossed: float = 1.5
    clearance: float = 2.8
    stop: float = 1.0
    time: float = 0.5
    headway: float = 1.0
    starting: float = 2.0
    comfortable: float = 3.0
    calm: float = 2.0
    holding: float = 5.0
    firm: float = 4.0


GIVING_WAY = GapAcceptance()


@dataclass(frozen=True, eq=False)
class Line:
    """The middle line of some lanes that are driven one after the other.

    Attributes:
        lanes: in order.
        starts: distances at which they begin [m].
        points: every `SPACING` metres [points, 2]; from lane to lane, they go over gradually.
        entering: distances at which the line leaves its lane for another one, or comes from a smaller road [m].
    """

    lanes: Lanes
    starts: Row
    points: Points
    entering: Row


@dataclass(frozen=True)
class Way:
    """Where a vehicle is going to drive.

    Attributes:
        vehicle: that drives there.
        line: of the lanes that it follows.
        place: of the vehicle on the line [m].
    """

    vehicle: Vehicle
    line: Line
    place: float

    def lane_at(self, point: int) -> Lane:
        """Return the lane at a point of the line."""
        number = int(np.searchsorted(self.line.starts, SPACING * point, side="right")) - 1
        return self.line.lanes[max(number, 0)]

    def enters_before(self, point: int) -> bool:
        """Return whether the vehicle leaves its lane, or comes from a smaller road, on its way to a point."""
        lane = self.line.lanes[0].shape
        _, aside = lane.local_coordinates(self.vehicle.position)
        if abs(aside) > lane.width_at(0.0) / 4 and self.place < lane.length:
            return True
        entering = self.line.entering
        return bool(np.any((entering > self.place - MERGING) & (entering <= SPACING * point + MERGING)))

    def ends_at(self, point: int) -> bool:
        """Return whether a point is the last one of the line, or the last one within reach."""
        end = min(SPACING * (len(self.line.points) - 1), self.place + GIVING_WAY.reach)
        return bool(SPACING * point > end - 2 * SPACING)


def way_of(vehicle: Vehicle, target: LaneIndex | None = None) -> Way:
    """Return where a vehicle is going to drive, if it went to another lane."""
    roads = road_map(vehicle.road.network)
    target = target or getattr(vehicle, "target_lane_index", None) or vehicle.lane_index
    route = tuple(getattr(vehicle, "route", None) or ())
    lanes = _lanes_ahead(roads, target, route)
    if vehicle.lane_index[1] == target[0]:  # it goes over to the next road before its lane ends
        lanes = (roads.lanes[vehicle.lane_index], *lanes)
    line = _line(roads, lanes)
    place, _ = line.lanes[0].shape.local_coordinates(vehicle.position)
    return Way(vehicle, line, float(place))


@kept
def _lanes_ahead(roads: RoadMap, first: LaneIndex, route: tuple[Any, ...]) -> Lanes:
    """Return a lane and the next ones on a route over the reach beyond it."""
    lanes = [roads.lanes[first]]
    covered = 0.0
    while covered < GIVING_WAY.reach:
        following = next_lane(lanes[-1], route)
        if following is None:
            break
        lanes.append(following)
        covered += following.length
    return tuple(lanes)


def next_lane(lane: Lane, route: tuple[Any, ...]) -> Lane | None:
    """Return the next lane on a route, without one the nearest; None where the road ends.

    It is the lane that highway-env's vehicles choose (``RoadNetwork.next_lane``), except where the route is missed,
    because its next lane begins more than one lane aside: then it is the nearest one, too.
    """
    last = lane.shape.position(lane.length, 0.0)

    def distance(other: Lane) -> float:
        return float(other.shape.distance(last))

    def aside(other: Lane) -> float:
        return abs(float(other.shape.local_coordinates(last)[1]))

    def continued(end: str, number: int | None) -> Lane:
        road = lane.roads.road(lane.end, end)
        if len(road) != len(lane.siblings):
            return min(road, key=distance)
        return road[lane.number if number is None else number]

    for start, end, number in route:
        if start == lane.end:
            wanted = continued(end, number)
            if aside(wanted) < GIVING_WAY.crossed * lane.shape.width_at(lane.length):
                return wanted
            break
    ends = lane.roads.graph.get(lane.end, {})
    return min((continued(end, None) for end in ends), key=distance, default=None)


@kept
def _line(roads: RoadMap, lanes: Lanes) -> Line:
    """Return the line along lanes."""
    starts = np.cumsum([0.0, *(lane.length for lane in lanes[:-1])])
    total = starts[-1] + lanes[-1].length
    ways = np.arange(0.0, total, SPACING)
    numbers = np.searchsorted(starts, ways, side="right") - 1
    points = np.array(
        [lanes[number].shape.position(way - starts[number], 0.0) for way, number in zip(ways, numbers, strict=True)]
    )
    entering = []
    for start, before, after in zip(starts[1:], lanes, lanes[1:], strict=False):
        jump = after.shape.position(0.0, 0.0) - before.shape.position(before.length, 0.0)
        later = ways >= start
        points[later] -= jump * np.exp(-(ways[later] - start) / MERGING)[:, None]
        changes = np.hypot(*jump) > before.shape.width_at(0.0) / 2
        if changes or len(after.siblings) > len(before.siblings):
            entering.append(start)
    return Line(lanes, starts, points, np.array(entering))


@dataclass(frozen=True)
class Approach:
    """How a vehicle approaches the place where its way meets another one.

    Attributes:
        vehicle: that approaches.
        distance: from its front to the place [m]; 0 inside it.
        length: of the place [m], infinite if both go on in the same lane.
        rank: right of way: the priority of its lane, and whether it stays in a lane of its road.
        order: that settles what nothing else does.
    """

    vehicle: Vehicle
    distance: float
    length: float
    rank: tuple[float, bool]
    order: int

    @property
    def braking(self) -> float:
        """Deceleration that it takes to stop before the place [m/s^2]."""
        return self._braking_to(0.0, self.distance)

    def braking_for(self, other: "Approach") -> float:
        """Return the deceleration that it takes to let another vehicle go first [m/s^2].

        If both go on in the same lane and the other is far enough ahead, it is enough to become as slow as the other.
        """
        room = self.distance - other.distance
        if other.distance > 0.0:
            room -= other.vehicle.LENGTH
        if np.isinf(self.length) and room > GIVING_WAY.stop:
            return self._braking_to(other.vehicle.speed, room)
        return self.braking

    def _braking_to(self, speed: float, room: float) -> float:
        """Return the deceleration to a speed [m/s] within some room [m], `GapAcceptance.stop` before its end."""
        squares = max(self.vehicle.speed**2 - speed**2, 0.0)
        return float(squares / (2 * max(room - GIVING_WAY.stop, 0.1)))

    def seconds(self, distance: float, acceleration: float = 0.0) -> float:
        """Return how long it takes to drive a distance [m], at constant speed or acceleration [s]."""
        speed = max(float(self.vehicle.speed), 0.0)
        if acceleration > 0.0:
            return float((np.sqrt(speed**2 + 2 * acceleration * distance) - speed) / acceleration)
        return distance / max(speed, 1e-3)

    @property
    def enters(self) -> float:
        """When it reaches the place at its present speed [s]."""
        return self.seconds(self.distance)

    @property
    def leaves(self) -> float:
        """When it has left the place at its present speed [s]."""
        return self.seconds(self.distance + self.length + self.vehicle.LENGTH)

    def goes_before(self, other: "Approach") -> bool:
        """Return whether this vehicle goes first.

        Whoever is in the place goes first, then who cannot stop before it, who has the right of way, and who comes
        first. Of two vehicles, exactly one goes first.
        """
        if (self.distance <= 0.0) != (other.distance <= 0.0):
            return self.distance <= 0.0
        late = self.braking > GIVING_WAY.firm
        if late != (other.braking > GIVING_WAY.firm):
            return late
        if self.rank != other.rank:
            return self.rank > other.rank
        return (self.enters, self.order) < (other.enters, other.order)

    def can_go_before(self, other: "Approach") -> bool:
        """Return whether this vehicle does not hinder another one that has the right of way, if it goes first."""
        if np.isinf(self.length):
            speed = np.sqrt(self.vehicle.speed**2 + 2 * GIVING_WAY.starting * self.distance)
            slowing = max(other.vehicle.speed - speed, 0.0) / GIVING_WAY.comfortable
            return self.seconds(self.distance, GIVING_WAY.starting) + GIVING_WAY.headway + slowing < other.enters
        passed = self.distance + self.length + self.vehicle.LENGTH
        return self.seconds(passed, GIVING_WAY.starting) + GIVING_WAY.time < other.enters


def conflicts(vehicle: Vehicle, target: LaneIndex | None = None) -> list[tuple[Approach, Approach]]:
    """Return how a vehicle and others approach the places where its way meets theirs, a pair for each of the others.

    Args:
        vehicle: whose way it is.
        target: lane to which it goes; by default, the one to which it goes already.
    """
    own = way_of(vehicle, target)
    vehicles = vehicle.road.vehicles
    own_order = vehicles.index(vehicle)
    found = []
    for order, other in enumerate(vehicles):
        if other is vehicle or np.hypot(*(other.position - vehicle.position)) > 2 * GIVING_WAY.reach:
            continue
        pair = _meeting(own, way_of(other), own_order, order)
        if pair is not None:
            found.append(pair)
    return found


def _meeting(own: Way, other: Way, own_order: int, order: int) -> tuple[Approach, Approach] | None:
    """Return how two vehicles approach the first place where their ways meet, None without one."""
    roads = {lane.index[:2] for way in (own, other) for lane in way.line.lanes}
    if len(roads) == 1:
        return None
    points, other_points = _close_points(own.line, other.line)

    # Points that neither has left with its rear, and that are within reach.
    rear = own.place - own.vehicle.LENGTH / 2
    begin, end = np.searchsorted(points, np.array([rear, own.place + GIVING_WAY.reach]) / SPACING)
    points = points[begin:end]
    other_points = other_points[begin:end]
    ahead = SPACING * other_points - other.place
    both = (ahead >= -other.vehicle.LENGTH / 2) & (ahead < GIVING_WAY.reach)
    if not both.any():
        return None
    points = points[both]
    other_points = other_points[both]

    # Vehicles that stay on one road until then are not in conflict.
    own_lane = own.lane_at(points[0])
    other_lane = other.lane_at(other_points.min())
    roads = {own.vehicle.lane_index[:2], other.vehicle.lane_index[:2], own_lane.index[:2], other_lane.index[:2]}
    if len(roads) == 1:
        return None

    # Ways that have not parted within reach go on in the same lane.
    on_own = np.unique(points)
    on_other = np.unique(other_points)
    shared = own.ends_at(on_own[-1]) or other.ends_at(on_other[-1])
    return _approach(own, on_own, own_lane, own_order, shared), _approach(other, on_other, other_lane, order, shared)


@kept
def _close_points(line: Line, other: Line) -> tuple[Numbers, Numbers]:
    """Return the numbers of points of two lines that are so close that vehicles on them would touch.

    Returns:
        Numbers of points of the one line, in order, and of points of the other line that are close to them.
    """
    close = cKDTree(line.points).sparse_distance_matrix(
        cKDTree(other.points), GIVING_WAY.clearance, output_type="coo_matrix"
    )
    order = np.lexsort((close.col, close.row))
    return close.row[order], close.col[order]


def _approach(way: Way, points: Numbers, lane: Lane, order: int, shared: bool) -> Approach:
    """Return how a vehicle approaches close points of its way; if they are not shared on, up to their first gap."""
    gaps = np.flatnonzero(np.diff(points) > 1)
    last = points[gaps[0]] if len(gaps) else points[-1]
    length = SPACING * (last - points[0]) if len(gaps) or not shared else np.inf
    distance = max(SPACING * points[0] - way.place - way.vehicle.LENGTH / 2, 0.0)
    rank = float(lane.shape.priority or 0), not way.enters_before(points[0])
    return Approach(way.vehicle, float(distance), float(length), rank, order)


def highest_acceleration(vehicle: Vehicle) -> float:
    """Return the highest acceleration with which a vehicle gives way to others, infinity if it need not [m/s^2]."""
    highest = np.inf
    for own, other in conflicts(vehicle):
        if own.distance <= 0.0 or own.goes_before(other) or own.can_go_before(other):
            continue
        if other.leaves + GIVING_WAY.time < own.enters:
            continue
        needed = own.braking_for(other)
        if needed > GIVING_WAY.calm:
            highest = min(highest, -needed)
        elif own.distance <= GIVING_WAY.stop:
            highest = min(highest, -GIVING_WAY.holding * vehicle.speed)
    return highest


def leaves_room(vehicle: Vehicle, target: LaneIndex) -> bool:
    """Return whether nobody has to brake hard where ways meet, if a vehicle goes to another lane."""
    for own, other in conflicts(vehicle, target):
        first, second = (own, other) if own.goes_before(other) else (other, own)
        apart = first.leaves + GIVING_WAY.time < second.enters
        if not apart and second.braking_for(first) > GIVING_WAY.comfortable:
            return False
    return True
