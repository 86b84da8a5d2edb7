"""Say where vehicles are going to drive: along their lane, and then along their route.

Ways are known, as drivers show them by indicators.
"""

from dataclasses import dataclass

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.geometry.lane_paths import Points, Row
from ms_highway.geometry.road_map import Lane, Lanes, RoadMap, cached_on_owner, road_map


@dataclass(frozen=True)
class WaySettings:
    """Set how far and how finely ways are known."""

    spacing: float = 1.5
    """Distance between the points of a way [m]; less than a width of a car."""
    reach: float = 60.0
    """Distance ahead that ways show [m]: more than it takes to stop from 20 m/s."""
    merging: float = 6.0
    """Distance in which a vehicle covers all but a third (1 / e) of the way to another
    lane [m].
    """
    lanes_crossed: float = 1.5
    """Widths of a lane that drivers cross at most where their lane ends."""


WAYS = WaySettings()


@dataclass(frozen=True, eq=False)
class Line:
    """The middle line of some lanes that are driven one after the other.

    Attributes:
        lanes: in order.
        starts: distances at which they begin [m].
        points: `WaySettings.spacing` apart [points, 2]; the line moves gradually from
            lane to lane.
        entering: distances at which the line leaves its lane for another one, or comes
            from a smaller road [m].
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
        distance = WAYS.spacing * point
        lanes_begun = np.searchsorted(self.line.starts, distance, side="right")
        number = max(int(lanes_begun) - 1, 0)
        return self.line.lanes[number]

    def enters_before(self, point: int) -> bool:
        """Return whether the vehicle enters another lane or road on its way to a point.

        It does if it leaves its lane, or comes from a smaller road.
        """
        # A vehicle beside the middle of its lane is changing lanes now.
        lane = self.line.lanes[0].shape
        _, offset = lane.local_coordinates(self.vehicle.position)
        is_beside = abs(offset) > lane.width_at(0.0) / 4
        if is_beside and self.place < lane.length:
            return True

        distance = WAYS.spacing * point
        entering = self.line.entering
        not_passed = entering > self.place - WAYS.merging
        not_later = entering <= distance + WAYS.merging
        return bool(np.any(not_passed & not_later))

    def ends_at(self, point: int) -> bool:
        """Return whether a point is the last one of the line, or of those in reach."""
        distance = WAYS.spacing * point
        length = WAYS.spacing * (len(self.line.points) - 1)
        end = min(length, self.place + WAYS.reach)
        return bool(distance > end - 2 * WAYS.spacing)


def way_of(vehicle: Vehicle, target: LaneIndex | None = None) -> Way:
    """Return where a vehicle is going to drive.

    Args:
        vehicle: any of highway-env's vehicles.
        target: lane to which it goes; by default, the one to which it goes already.
    """
    roads = road_map(vehicle.road.network)
    own_target = getattr(vehicle, "target_lane_index", None)
    first = target or own_target or vehicle.lane_index
    route = tuple(getattr(vehicle, "route", None) or ())
    lanes = _lanes_ahead(roads, first, route)

    # Before its lane ends, a vehicle may already have the next one as its target.
    start_of_target = first[0]
    end_of_present = vehicle.lane_index[1]
    if end_of_present == start_of_target:
        lanes = (roads.lanes[vehicle.lane_index], *lanes)

    line = _line(roads, lanes)
    place, _ = line.lanes[0].shape.local_coordinates(vehicle.position)
    return Way(vehicle, line, float(place))


@cached_on_owner
def _lanes_ahead(
    roads: RoadMap,
    first: LaneIndex,
    route: tuple[LaneIndex, ...],
) -> Lanes:
    """Return a lane and the next ones on a route over the reach beyond it."""
    lanes = [roads.lanes[first]]
    covered = 0.0
    while covered < WAYS.reach:
        following = next_lane(lanes[-1], route)
        if following is None:
            break
        lanes.append(following)
        covered += following.length
    return tuple(lanes)


def next_lane(lane: Lane, route: tuple[LaneIndex, ...]) -> Lane | None:
    """Return the next lane on a route, without one the nearest; None at a road's end.

    It is the lane that highway-env's vehicles choose (``RoadNetwork.next_lane``). Only
    where the route's next lane begins more than one lane aside, the route is missed,
    and it is the nearest lane, too.
    """
    last = lane.shape.position(lane.length, 0.0)

    def distance(other: Lane) -> float:
        return float(other.shape.distance(last))

    def continued(end: str, number: int | None) -> Lane:
        """Return the next lane on the road to a node, with this number if it has one.

        On a road with another number of lanes, it is the nearest one.
        """
        road = lane.roads.road(lane.end, end)
        if len(road) != len(lane.siblings):
            return min(road, key=distance)
        if number is None:
            number = lane.number
        return road[number]

    # The lane of the route, unless it is too far aside.
    width = lane.shape.width_at(lane.length)
    for start, end, number in route:
        if start == lane.end:
            continuing = continued(end, number)
            _, offset = continuing.shape.local_coordinates(last)
            if abs(offset) < WAYS.lanes_crossed * width:
                return continuing
            break

    # The nearest lane of all roads.
    ends = lane.roads.graph.get(lane.end, {})
    candidates = [continued(end, None) for end in ends]
    return min(candidates, key=distance, default=None)


@cached_on_owner
def _line(roads: RoadMap, lanes: Lanes) -> Line:
    """Return the line along lanes."""
    # Points on the middle of each lane.
    lengths = [lane.length for lane in lanes]
    starts = np.cumsum([0.0, *lengths[:-1]])
    places = np.arange(0.0, starts[-1] + lengths[-1], WAYS.spacing)
    lane_of_place = np.searchsorted(starts, places, side="right") - 1
    points = np.zeros((len(places), 2))
    for point, number in enumerate(lane_of_place):
        along = places[point] - starts[number]
        points[point] = lanes[number].shape.position(along, 0.0)

    # Where a lane does not begin at the end of the one before, move over gradually.
    entering = []
    for start, before, after in zip(starts[1:], lanes, lanes[1:], strict=False):
        end = before.shape.position(before.length, 0.0)
        jump = after.shape.position(0.0, 0.0) - end
        later = places >= start
        distance = places[later] - start
        share_left = np.exp(-distance / WAYS.merging)
        points[later] -= jump * share_left[:, None]

        changes_lane = np.hypot(*jump) > before.shape.width_at(0.0) / 2
        comes_from_smaller_road = len(after.siblings) > len(before.siblings)
        if changes_lane or comes_from_smaller_road:
            entering.append(start)
    return Line(lanes, starts, points, np.array(entering))
