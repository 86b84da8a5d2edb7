"""Observe the road from a vehicle as a `RoadScene`."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.geometry.curve import BEHIND, SPACING, Curve
from ms_highway.geometry.lane_paths import Point, paths_from, project_cars
from ms_highway.geometry.road_map import (
    Chain,
    Destination,
    Goal,
    Spot,
    road_map,
)
from ms_highway.perception.corridor import Corridor, corridor
from ms_highway.perception.scene import SHAPE, RoadScene
from ms_highway.perception.traffic_paths import traffic_of


@dataclass(frozen=True)
class FollowedLanes:
    """Set how many lanes a robot follows."""

    behind: float = 60.0
    """Length of lanes behind the robot [m]."""
    needed_ahead: float = 190.0
    """Length of lanes ahead below which they are extended [m]."""
    planned_ahead: float = 260.0
    """Length of lanes ahead to which they are extended [m]."""


FOLLOWED_LANES = FollowedLanes()


@dataclass
class Memory:
    """Hold what a robot remembers between observations.

    It is stored on the vehicle, so that copies of it observe the same.

    Attributes:
        goal: to which the lanes lead.
        lanes: that the robot follows, none before the first observation.
        way: position of its rear axle along these lanes [m].
        numbers: of the others that it has observed.
    """

    goal: Destination = None
    lanes: tuple[LaneIndex, ...] = ()
    way: float = 0.0
    numbers: dict[RoadObject, int] = field(default_factory=dict)


def observe_road(
    vehicle: Vehicle,
    destination: str | Spot | None = None,
    applied: tuple[float, float] = (0.0, 0.0),
    intentions: bool = False,
) -> RoadScene:
    """Observe the road from a vehicle.

    The vehicle remembers its lanes, so that its route does not jump where lanes meet.
    Without a destination it follows its ``route`` to its end, if it has one, and then
    the road that continues the present one best.

    Args:
        vehicle: the robot.
        destination: node of the network to drive to, or a spot.
        applied: last curvature and acceleration of the robot [1/m, m/s^2].
        intentions: whether the ``route`` of each of the others is known, as from
            indicators.
    """
    roads = road_map(vehicle.road.network)
    memory = vars(vehicle).setdefault("road_memory", Memory())
    destination_now = destination or _roads_of_route(vehicle) or None
    goal = roads.goal(destination_now)

    # The lanes to follow, and the robot's place on the curve along them.
    position = None
    if memory.lanes and memory.goal == destination_now:
        position = _continued(vehicle, goal, memory)
    if position is None:
        position = _first_position(vehicle, goal)
    s, d, heading = position.pose
    memory.goal = destination_now
    memory.lanes = position.chain.indices
    memory.way = position.way

    # The route from there, and the lane changes that the goal asks for.
    knots = s - BEHIND + SPACING * np.arange(SHAPE.route_knots)
    path = paths_from([position.around.curve], np.array([s]), SHAPE.route_knots)
    route = Curve(path.x[0], path.y[0], path.heading[0], path.curvature[0])
    middle = position.way + vehicle.LENGTH / 2
    changes, room = goal.changes(position.chain, middle)
    return RoadScene(
        route=route,
        changes=np.array(changes, np.float32),
        room=np.array(room, np.float32),
        robot=np.array([0.0, d, heading, vehicle.speed], np.float32),
        size=np.array([vehicle.LENGTH, vehicle.WIDTH], np.float32),
        applied=np.array(applied, np.float32),
        **position.around.at(knots),
        **traffic_of(vehicle, roads, memory.numbers, intentions),
    )


def _roads_of_route(vehicle: Vehicle) -> tuple[tuple[str, str], ...]:
    """Return the roads of a vehicle's ``route``, none without a route."""
    route = getattr(vehicle, "route", None) or ()
    return tuple((start, end) for start, end, _ in route)


class RoutePosition(NamedTuple):
    """The lanes that the robot follows, and where it is on them.

    Attributes:
        chain: lanes to follow.
        way: position of the rear axle along them [m].
        around: the road around them.
        pose: s, d and relative heading on the curve of ``around``.
    """

    chain: Chain
    way: float
    around: Corridor
    pose: tuple[float, float, float]


def _rear_axle(vehicle: Vehicle) -> Point:
    """Return the position of the middle of a vehicle's rear axle [m]."""
    return vehicle.position - vehicle.LENGTH / 2 * vehicle.direction


def _pose_on(
    around: Corridor,
    vehicle: Vehicle,
    way: float,
) -> tuple[float, float, float]:
    """Return s, d and the relative heading of the rear axle on the curve of a route."""
    positions = _rear_axle(vehicle)[None]
    headings = np.array([vehicle.heading], dtype=float)
    ways = np.array([way])
    s, d, relative_heading = project_cars([around.curve], positions, headings, ways)
    return float(s[0]), float(d[0]), float(relative_heading[0])


def _position_on(
    chain: Chain,
    vehicle: Vehicle,
    goal: Goal,
    way: float,
) -> RoutePosition:
    """Return the position on lanes to follow, from the way along them [m]."""
    around = corridor(chain, goal, way // Chain.block_length)
    return RoutePosition(chain, way, around, _pose_on(around, vehicle, way))


def _continued(
    vehicle: Vehicle,
    goal: Goal,
    memory: Memory,
) -> RoutePosition | None:
    """Return the position on the lanes that the robot has followed so far.

    It is None if the robot has changed lanes.
    """
    # Where the robot is on the lanes that it has followed so far.
    lanes = tuple(goal.roads.lanes[index] for index in memory.lanes)
    chain = goal.roads.chain(lanes)
    last_block = memory.way // Chain.block_length
    last = _position_on(chain, vehicle, goal, memory.way)
    way = last.around.curve.way(last.pose[0])

    # It has changed lanes if it is on one of their roads nearby, but in another lane.
    leg = chain.leg(way + vehicle.LENGTH / 2)
    nearby_lanes = chain.indices[max(leg - 1, 0) : leg + 2]
    lane = vehicle.lane_index
    is_on_roads = any(other[:2] == lane[:2] for other in nearby_lanes)
    if lane not in nearby_lanes and is_on_roads:
        return None

    # Extend the lanes before they end.
    if chain.starts[-1] - way <= FOLLOWED_LANES.needed_ahead:
        first = chain.leg(way - FOLLOWED_LANES.behind)
        length = FOLLOWED_LANES.planned_ahead + way - chain.starts[leg]
        ahead = goal.ahead(chain.lanes[leg], length)
        way -= chain.starts[first]
        chain = goal.roads.chain(chain.lanes[first:leg] + ahead)
    elif way // Chain.block_length == last_block:
        return last._replace(way=way)
    return _position_on(chain, vehicle, goal, way)


def _first_position(vehicle: Vehicle, goal: Goal) -> RoutePosition:
    """Return the position on lanes that begin behind the robot's present lane."""
    lane = goal.roads.lanes[vehicle.lane_index]
    along, _ = lane.shape.local_coordinates(_rear_axle(vehicle))
    place = float(along)
    behind = lane.behind(FOLLOWED_LANES.behind - place)
    ahead = goal.ahead(lane, FOLLOWED_LANES.planned_ahead + place)
    chain = goal.roads.chain(behind + ahead)
    way = chain.starts[len(behind)] + place
    return _position_on(chain, vehicle, goal, way)
