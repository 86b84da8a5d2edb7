"""Observe the road from a vehicle as a `RoadScene`."""

from dataclasses import dataclass, field
from math import inf

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.geometry.curve import BEHIND, SPACING
from ms_highway.geometry.lane_paths import Point
from ms_highway.geometry.road_map import BLOCK, Chain, Destination, Goal, Spot, road_map
from ms_highway.perception.corridor import corridor
from ms_highway.perception.scene import KNOTS, RoadScene
from ms_highway.perception.traffic_paths import traffic_of

KEPT_BEHIND = 60.0  # m of lanes behind the robot
NEEDED, PLANNED = 190.0, 260.0  # m of lanes ahead: below the first length, they are extended to the second


@dataclass
class Memory:
    """What a robot remembers between observations; stored on the vehicle, so that copies of it observe the same.

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

    The vehicle remembers its lanes, so that its route does not jump where lanes meet. Without a destination it follows
    its ``route`` to its end, if it has one, and then the road that continues the present one best.

    Args:
        vehicle: the robot.
        destination: node of the network to drive to, or a spot.
        applied: last curvature and acceleration of the robot [1/m, m/s^2].
        intentions: whether the ``route`` of each of the others is known, as from indicators.
    """
    roads = road_map(vehicle.road.network)
    followed = tuple((start, end) for start, end, _ in getattr(vehicle, "route", None) or ())
    wanted = destination or followed or None
    goal, memory = roads.goal(wanted), vars(vehicle).setdefault("road_memory", Memory())
    rear = vehicle.position - vehicle.LENGTH / 2 * vehicle.direction
    ride = _continued(vehicle, rear, goal, memory) if memory.lanes and memory.goal == wanted else None
    chain, way = ride or _begun(vehicle, rear, goal)
    memory.goal, memory.lanes, memory.way = wanted, tuple(lane.index for lane in chain.lanes), way
    around = corridor(chain, goal, way // BLOCK)
    s, d, heading = around.curve.project(rear, vehicle.heading, way)
    route = around.curve.path(s, KNOTS)
    changes, room = _changes(chain, goal, way + vehicle.LENGTH / 2)
    return RoadScene(
        route=route,
        changes=np.array(changes, np.float32),
        room=np.array(room, np.float32),
        robot=np.array([0.0, d, heading, vehicle.speed], np.float32),
        size=np.array([vehicle.LENGTH, vehicle.WIDTH], np.float32),
        applied=np.array(applied, np.float32),
        **around.at(s - BEHIND + SPACING * np.arange(KNOTS)),
        **traffic_of(vehicle, roads, memory.numbers, intentions),
    )


def _continued(vehicle: Vehicle, rear: Point, goal: Goal, memory: Memory) -> tuple[Chain, float] | None:
    """Return the lanes to follow and the present way along them; None if the robot has changed lanes."""
    chain = goal.roads.chain(tuple(goal.roads.lanes[index] for index in memory.lanes))
    curve = corridor(chain, goal, memory.way // BLOCK).curve
    s, _, _ = curve.project(rear, vehicle.heading, memory.way)
    way = curve.way(s)
    leg = chain.leg(way + vehicle.LENGTH / 2)
    near, index = [lane.index for lane in chain.lanes[max(leg - 1, 0) : leg + 2]], vehicle.lane_index
    if index not in near and any(other[:2] == index[:2] for other in near):
        return None
    if chain.starts[-1] - way > NEEDED:
        return chain, way
    first = chain.leg(way - KEPT_BEHIND)
    lanes = chain.lanes[first:leg] + goal.ahead(chain.lanes[leg], PLANNED + way - chain.starts[leg])
    return goal.roads.chain(lanes), way - chain.starts[first]


def _begun(vehicle: Vehicle, rear: Point, goal: Goal) -> tuple[Chain, float]:
    """Return the lanes to follow, beginning behind the robot's present lane, and the present way along them."""
    lane = goal.roads.lanes[vehicle.lane_index]
    place = float(lane.shape.local_coordinates(rear)[0])
    behind = lane.behind(KEPT_BEHIND - place)
    chain = goal.roads.chain(behind + goal.ahead(lane, PLANNED + place))
    return chain, chain.starts[len(behind)] + place


def _changes(chain: Chain, goal: Goal, way: float) -> tuple[list[int], float]:
    """Return the lane changes to the right that the goal asks for from three lanes (left, own, right), and their room.

    Args:
        chain: lanes of the robot.
        goal: of the robot.
        way: position of the robot along its lanes [m].
    """
    leg = chain.leg(way)
    own, place = chain.lanes[leg], way - chain.starts[leg]
    needed, room = goal.demand(own)
    beside = [(own.beside(step), step) for step in (-1, 0, 1)]
    demands = [goal.demand(lane) if lane else (needed - step, inf) for lane, step in beside]
    room = room if needed else min(until for _, until in demands)
    return [changes for changes, _ in demands], max(room - place, 0.0)
