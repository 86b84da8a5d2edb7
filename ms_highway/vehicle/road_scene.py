"""See the road from a vehicle as a `RoadScene`."""

from dataclasses import dataclass
from math import inf
from weakref import WeakKeyDictionary

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Float

from ms_highway.game.road import BEHIND, KNOTS, SPACING, RoadScene
from ms_highway.vehicle.corridor import corridor
from ms_highway.vehicle.road_map import Chain, Goal, LaneIndex, RoadMap, road_map
from ms_highway.vehicle.traffic_paths import traffic_of

__all__ = ["observe_road"]

KEPT_BEHIND = 60.0  # m of lanes behind the robot
NEEDED, PLANNED = 190.0, 260.0  # m of lanes ahead, at least, and when they are looked up anew
ASTRAY = 0.8  # rad, from the route
UNSURE = 1.5  # m, by which a lane that leads to the goal may be farther than the nearest one


@dataclass(frozen=True)
class _Ride:
    """The lanes that a robot follows, and the way at which it is along them [m]."""

    roads: RoadMap
    goal: Goal
    chain: Chain
    way: float


_rides: WeakKeyDictionary[Vehicle, _Ride] = WeakKeyDictionary()


def observe_road(
    vehicle: Vehicle, destination: str | None = None, applied: tuple[float, float] = (0.0, 0.0)
) -> RoadScene:
    """See the road from a vehicle.

    Lanes once followed are remembered by vehicle, so that its route does not jump where lanes meet. Without a
    destination it follows its ``route``, as far as it has one, and then whichever road continues the present one best.

    Args:
        vehicle: the robot.
        destination: node of the network to drive to.
        applied: curvature and acceleration that the robot has applied last [1/m, m/s^2].
    """
    roads = road_map(vehicle.road.network)
    goal: Goal = destination or tuple((start, end) for start, end, _ in getattr(vehicle, "route", None) or ()) or None
    rear = vehicle.position - vehicle.LENGTH / 2 * vehicle.direction
    ride = _rides[vehicle] = _ride(vehicle, rear, roads, goal)
    around = corridor(roads, ride.chain, goal, ride.way)
    s, d, heading = around.curve.project(rear, vehicle.heading, ride.way)
    route = around.curve.path(s, KNOTS)
    lanes, is_open, edges, limit = around.at(s - BEHIND + SPACING * np.arange(KNOTS))
    starts, own = roads.starts(ride.chain), roads.leg(ride.chain, ride.way + vehicle.LENGTH / 2)
    changes, room = _changes(roads, ride.chain[own], goal, ride.way + vehicle.LENGTH / 2 - starts[own])
    others = traffic_of(vehicle, roads, route, ride.chain, ride.way)
    return RoadScene(
        route=route,
        lanes=lanes,
        open=is_open,
        edges=edges,
        speed_limit=limit,
        changes=changes,
        room=np.asarray(room, dtype=np.float32),
        robot=np.array([0.0, d, heading, vehicle.speed], dtype=np.float32),
        size=np.array([vehicle.LENGTH, vehicle.WIDTH], dtype=np.float32),
        applied=np.array(applied, dtype=np.float32),
        **vars(others),
    )


def _ride(vehicle: Vehicle, rear: Float[np.ndarray, "2"], roads: RoadMap, goal: Goal) -> _Ride:
    """Return the lanes that a robot follows now: as before, unless it has changed lanes or left them."""
    ride = _rides.get(vehicle)
    if ride is None or ride.roads is not roads or ride.goal != goal:
        return _begin(vehicle, rear, roads, goal)
    curve = roads.curve(ride.chain, ride.way)
    s, _, _ = curve.project(rear, vehicle.heading, ride.way)
    way = curve.way(s)
    _, d, heading = curve.project(vehicle.position, vehicle.heading, way)
    leg = roads.leg(ride.chain, way + vehicle.LENGTH / 2)
    near = ride.chain[max(leg - 1, 0) : leg + 2]
    index = vehicle.lane_index
    if index not in near:
        changed = any(other[:2] == index[:2] for other in near)
        if changed or abs(d) > roads.lanes[ride.chain[leg]].width_at(0.0) / 2 or abs(heading) > ASTRAY:
            return _begin(vehicle, rear, roads, goal)
    starts = roads.starts(ride.chain)
    if starts[-1] - way > NEEDED:
        return _Ride(roads, goal, ride.chain, way)
    first = roads.leg(ride.chain, way - KEPT_BEHIND)
    chain = ride.chain[first:leg] + roads.ahead(ride.chain[leg], goal, PLANNED + way - starts[leg])
    return _Ride(roads, goal, chain, way - starts[first])


def _begin(vehicle: Vehicle, rear: Float[np.ndarray, "2"], roads: RoadMap, goal: Goal) -> _Ride:
    """Return the lanes that a robot follows from its present lane on, and those behind it."""
    index = _lane(vehicle, roads, goal)
    place = float(roads.lanes[index].local_coordinates(rear)[0])
    behind = roads.behind(index, KEPT_BEHIND - place)
    chain = behind + roads.ahead(index, goal, PLANNED + place)
    return _Ride(roads, goal, chain, roads.starts(chain)[len(behind)] + place)


def _lane(vehicle: Vehicle, roads: RoadMap, goal: Goal) -> LaneIndex:
    """Return the lane of a robot: the nearest one, or one hardly farther that leads to the goal."""
    index, towards = vehicle.lane_index, roads.towards(goal)
    if not isinstance(goal, str) or index[1] in towards or index[1] == goal:
        return index
    leading = [other for other in roads.lanes if other[1] in towards or other[1] == goal]
    distance = {
        other: roads.lanes[other].distance_with_heading(vehicle.position, vehicle.heading)
        for other in [index, *leading]
    }
    best = min(leading, key=distance.__getitem__, default=index)
    return best if distance[best] < distance[index] + UNSURE else index


def _changes(roads: RoadMap, own: LaneIndex, goal: Goal, place: float) -> tuple[Float[np.ndarray, "lanes"], float]:
    """Return changes of lane to the right needed from the left, the own and the right lane, and the room for them.

    Args:
        roads: of the network.
        own: the robot's lane.
        goal: of the robot.
        place: of it along its lane [m].
    """
    needed, room = roads.demand(own, goal)
    changes, rooms = [], []
    for step in (-1, 0, 1):
        index = roads.beside(own, step)
        count, until = roads.demand(index, goal) if index else (needed - step, inf)
        changes.append(count)
        rooms.append(until)
    if not needed:
        room = min(rooms)
    return np.array(changes, dtype=np.float32), max(room - place, 0.0)
