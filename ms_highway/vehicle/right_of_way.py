"""Decide who goes first where ways cross or meet, and how hard the others brake for it.

Vehicles that stay on one road are not in conflict: they follow each other, or drive
beside each other and change lanes, both of which is decided elsewhere.
"""

from dataclasses import dataclass

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Bool
from scipy.spatial import cKDTree

from ms_highway.geometry.road_map import Lane, cached_on_owner
from ms_highway.runtime.arrays import Numbers
from ms_highway.vehicle.ways import WAYS, Line, Way, way_of


@dataclass(frozen=True)
class GapAcceptance:
    """Set what drivers keep to where ways meet."""

    clearance: float = 2.8
    """Distance of two ways below which vehicles on them would touch [m]: a width, and
    room for steering.
    """
    stop: float = 1.0
    """Distance from a conflict at which drivers wait for it to be free [m]."""
    time: float = 0.5
    """Time between one vehicle leaving a conflict and the other one entering it [s]."""
    headway: float = 1.0
    """Time by which a driver enters a lane ahead of a vehicle with the right of way
    [s].
    """
    starting: float = 2.0
    """Acceleration with which a driver expects to enter a gap [m/s^2]."""
    comfortable: float = 3.0
    """Deceleration that a driver imposes on a vehicle with the right of way at most
    [m/s^2].
    """
    calm: float = 2.0
    """Deceleration up to which drivers do not brake yet before a conflict [m/s^2]."""
    holding: float = 5.0
    """Deceleration of a driver who waits, per speed [1/s]; so it never rolls back."""
    firm: float = 4.0
    """Deceleration above which a vehicle is expected not to stop any more [m/s^2]."""


GIVING_WAY = GapAcceptance()


@dataclass(frozen=True)
class Approach:
    """How a vehicle approaches the place where its way meets another one.

    Attributes:
        vehicle: that approaches.
        distance: from its front to the place [m]; 0 inside it.
        length: of the place [m], infinite if both go on in the same lane.
        rank: right of way: the priority of its lane, and whether it stays in a lane of
            its road.
        order: the vehicle's number on the road, which breaks ties.
    """

    vehicle: Vehicle
    distance: float
    length: float
    rank: tuple[float, bool]
    order: int

    @property
    def passed(self) -> float:
        """Distance after which the vehicle has left the place [m]."""
        return self.distance + self.length + self.vehicle.LENGTH

    @property
    def enters(self) -> float:
        """When it reaches the place at its present speed [s]."""
        return self._seconds(self.distance)

    @property
    def leaves(self) -> float:
        """When it has left the place at its present speed [s]."""
        return self._seconds(self.passed)

    @property
    def braking(self) -> float:
        """Deceleration that it takes to stop before the place [m/s^2]."""
        return self._braking_to(0.0, self.distance)

    def braking_for(self, other: "Approach") -> float:
        """Return the deceleration with which it lets another go first [m/s^2].

        If both go on in the same lane and the other is far enough ahead, it is enough
        to become as slow as the other.
        """
        room = self.distance - other.distance
        if other.distance > 0.0:
            room -= other.vehicle.LENGTH
        if np.isinf(self.length) and room > GIVING_WAY.stop:
            return self._braking_to(other.vehicle.speed, room)
        return self.braking

    def goes_before(self, other: "Approach") -> bool:
        """Return whether this vehicle goes first.

        Whoever is in the place goes first, then who cannot stop before it, who has the
        right of way, and who comes first. Of two vehicles, exactly one goes first.
        """
        inside = self.distance <= 0.0
        other_inside = other.distance <= 0.0
        if inside != other_inside:
            return inside
        late = self.braking > GIVING_WAY.firm
        other_late = other.braking > GIVING_WAY.firm
        if late != other_late:
            return late
        if self.rank != other.rank:
            return self.rank > other.rank
        return (self.enters, self.order) < (other.enters, other.order)

    def can_go_before(self, other: "Approach") -> bool:
        """Return whether it goes first without hindering one with the right of way."""
        if not np.isinf(self.length):
            passed = self._seconds(self.passed, GIVING_WAY.starting)
            return passed + GIVING_WAY.time < other.enters

        # In the same lane, the other may have to slow down behind it.
        gained = 2 * GIVING_WAY.starting * self.distance
        speed = np.sqrt(self.vehicle.speed**2 + gained)
        slowing = max(other.vehicle.speed - speed, 0.0) / GIVING_WAY.comfortable
        entered = self._seconds(self.distance, GIVING_WAY.starting)
        return entered + GIVING_WAY.headway + slowing < other.enters

    def _braking_to(self, speed: float, room: float) -> float:
        """Return the deceleration to a speed within some room [m/s^2].

        The vehicle has that speed `GapAcceptance.stop` before the end of the room.
        """
        squares = max(self.vehicle.speed**2 - speed**2, 0.0)
        distance = max(room - GIVING_WAY.stop, 0.1)
        return float(squares / (2 * distance))

    def _seconds(self, distance: float, acceleration: float = 0.0) -> float:
        """Return how long it drives a distance, with a constant acceleration [s]."""
        speed = max(float(self.vehicle.speed), 0.0)
        if acceleration > 0.0:
            final = np.sqrt(speed**2 + 2 * acceleration * distance)
            return float((final - speed) / acceleration)
        return distance / max(speed, 1e-3)


Conflict = tuple[Approach, Approach]


def conflicts(vehicle: Vehicle, target: LaneIndex | None = None) -> list[Conflict]:
    """Return where a vehicle's way meets those of others, one place for each of them.

    Args:
        vehicle: whose way it is.
        target: lane to which it goes; by default, the one to which it goes already.

    Returns:
        Pairs of how the vehicle and the other one approach the place.
    """
    own = way_of(vehicle, target)
    vehicles = vehicle.road.vehicles
    own_order = vehicles.index(vehicle)
    found = []
    for order, other in enumerate(vehicles):
        if other is vehicle:
            continue
        if np.hypot(*(other.position - vehicle.position)) > 2 * WAYS.reach:
            continue
        conflict = _meeting(own, way_of(other), own_order, order)
        if conflict is not None:
            found.append(conflict)
    return found


def _meeting(own: Way, other: Way, own_order: int, order: int) -> Conflict | None:
    """Return how two vehicles approach the first place where their ways meet."""
    roads = {lane.index[:2] for way in (own, other) for lane in way.line.lanes}
    if len(roads) == 1:
        return None

    # Points where the ways are close, that neither has left and that are within reach.
    points, other_points = _close_points(own.line, other.line)
    counts = _in_reach(own, points) & _in_reach(other, other_points)
    if not counts.any():
        return None
    on_own = np.unique(points[counts])
    on_other = np.unique(other_points[counts])

    # Vehicles that stay on one road until then are not in conflict.
    own_lane = own.lane_at(on_own[0])
    other_lane = other.lane_at(on_other[0])
    lanes = (
        own.vehicle.lane_index,
        other.vehicle.lane_index,
        own_lane.index,
        other_lane.index,
    )
    roads = {index[:2] for index in lanes}
    if len(roads) == 1:
        return None

    # Ways that have not parted within reach go on in the same lane.
    shared = own.ends_at(on_own[-1]) or other.ends_at(on_other[-1])
    own_approach = _approach(own, on_own, own_lane, own_order, shared)
    other_approach = _approach(other, on_other, other_lane, order, shared)
    return own_approach, other_approach


def _in_reach(way: Way, points: Numbers) -> Bool[np.ndarray, "points"]:
    """Return which points a vehicle has not left, and are within reach."""
    ahead = WAYS.spacing * points - way.place
    return (ahead >= -way.vehicle.LENGTH / 2) & (ahead < WAYS.reach)


@cached_on_owner
def _close_points(line: Line, other: Line) -> tuple[Numbers, Numbers]:
    """Return where two lines are so close that vehicles on them would touch.

    Returns:
        Numbers of points of the one line, and of the points of the other line that are
        close to them.
    """
    tree = cKDTree(line.points)
    other_tree = cKDTree(other.points)
    close = tree.sparse_distance_matrix(
        other_tree, GIVING_WAY.clearance, output_type="coo_matrix"
    )
    return close.row, close.col


def _approach(
    way: Way,
    points: Numbers,
    lane: Lane,
    order: int,
    shared: bool,
) -> Approach:
    """Return how a vehicle approaches points of its way.

    Args:
        way: of the vehicle.
        points: numbers of the points that are close to the other way, in order.
        lane: at the first one.
        order: of the vehicle on the road.
        shared: whether both go on in the same lane.
    """
    # The place ends at the first gap between the points, or never if it is shared.
    first = points[0]
    gaps = np.flatnonzero(np.diff(points) > 1)
    last = points[gaps[0]] if len(gaps) else points[-1]
    goes_on = shared and not len(gaps)
    length = np.inf if goes_on else WAYS.spacing * (last - first)

    front = way.place + way.vehicle.LENGTH / 2
    distance = max(WAYS.spacing * first - front, 0.0)
    priority = float(lane.shape.priority or 0)
    stays_in_lane = not way.enters_before(int(first))
    rank = (priority, stays_in_lane)
    return Approach(way.vehicle, float(distance), float(length), rank, order)


def highest_acceleration(vehicle: Vehicle) -> float:
    """Return the highest acceleration with which a vehicle gives way [m/s^2].

    It is infinite if there is nobody to whom it has to give way.
    """
    highest = np.inf
    for own, other in conflicts(vehicle):
        # A vehicle that is in the place, or goes first, need not give way.
        if own.distance <= 0.0 or own.goes_before(other):
            continue

        # Nor does one that passes before or after the other one.
        passes_after = other.leaves + GIVING_WAY.time < own.enters
        if own.can_go_before(other) or passes_after:
            continue

        needed = own.braking_for(other)
        if needed > GIVING_WAY.calm:
            highest = min(highest, -needed)
        elif own.distance <= GIVING_WAY.stop:
            highest = min(highest, -GIVING_WAY.holding * vehicle.speed)
    return highest


def leaves_room(vehicle: Vehicle, target: LaneIndex) -> bool:
    """Return whether a vehicle can go to another lane so that nobody brakes hard.

    Only conflicts where ways meet count.
    """
    for own, other in conflicts(vehicle, target):
        own_first = own.goes_before(other)
        first = own if own_first else other
        second = other if own_first else own
        apart = first.leaves + GIVING_WAY.time < second.enters
        if not apart and second.braking_for(first) > GIVING_WAY.comfortable:
            return False
    return True
