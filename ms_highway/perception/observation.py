"""Observe the road from a vehicle as a `RoadScene`; measure the lanes beside its route
and the edges of the road.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject
from jaxtyping import Bool

from ms_highway.geometry.curve import BEHIND, SPACING, Curve, Rows
from ms_highway.geometry.lane_paths import (
    LANE_PATHS,
    LaneCurve,
    Point,
    Row,
    paths_from,
    project_cars,
    samples,
)
from ms_highway.geometry.road_map import (
    Chain,
    Destination,
    Goal,
    Lane,
    Spot,
    cached_on_owner,
    road_map,
)
from ms_highway.perception.scene import SHAPE, RoadScene
from ms_highway.perception.traffic_paths import traffic_of

LANE_MARGIN = 6.0  # m, by which lanes are sampled beyond the route beside them
MIN_LANE_COSINE = (
    0.7  # lower bound of the cosine of the angle between a lane and the route
)
LANE_EXTENSION = 3.0  # m, up to which a lane is extended straight on
DRIVEN = (6.0, 4.0, 3.0, 2.0)  # m, smoothing widths of routes, which cut corners
WITHIN = (
    0.1  # m from the lanes, beyond which a route is smoothed less, as in sharp bends
)
NEARBY = (
    2.0  # widths of a lane within which the robot can change to a lane that diverges
)


@dataclass(frozen=True)
class Corridor:
    """A route's curve and, at its samples, the road around it.

    Attributes:
        curve: of the route.
        rows: lateral positions of the lanes left of it, on it, right of it, and of the
            road's edges [m].
        open: where the robot may drive on the lanes.
    """

    curve: LaneCurve
    rows: Rows
    open: Bool[np.ndarray, "lanes samples"]

    def at(self, s: Row) -> dict[str, Any]:
        """Return the fields of a ``RoadScene`` that describe lanes, at distances from
        the curve's beginning [m].
        """
        rows = self.curve.curve.interpolate(self.rows, s).astype(np.float32)
        nearest = np.clip(
            np.round(s / LANE_PATHS.spacing).astype(int), 0, self.open.shape[1] - 1
        )
        return {
            "lanes": rows[: SHAPE.lanes],
            "edges": rows[SHAPE.lanes :],
            "open": self.open[:, nearest],
        }


@cached_on_owner
def corridor(chain: Chain, goal: Goal, block: float) -> Corridor:
    """Return the corridor of the route along a chain of lanes near a block of it."""
    curve = chain.curve(block, DRIVEN, WITHIN)
    ways = curve.ways
    rows = np.zeros((SHAPE.lanes + 2, ways.size))
    is_open = np.zeros((SHAPE.lanes, ways.size), dtype=bool)
    low = 0
    lanes = rows[: SHAPE.lanes]
    edges = rows[SHAPE.lanes :]
    for until, (left, own, right) in _sections(chain, goal, ways[-1]):
        here = slice(low, int(np.searchsorted(ways, until)))
        if here.stop <= here.start:
            continue
        low = here.stop
        width = float((own or chain.lanes[-1]).shape.width_at(0.0))
        lanes[:, here] = np.array([[-width], [0.0], [width]])
        is_open[1, here] = bool(own)
        centres = [lanes[1, here]] if own else []
        for place, lane, step in ((0, left, -1), (2, right, 1)):
            if lane:
                beside = lanes[place, here] = _beside(curve.curve, here, lane)
                inside = is_open[place, here] = ~(np.abs(beside) >= NEARBY * width)
                centres.append(np.where(inside, beside, 0.0))
                outermost = _outermost(lane, step)
                if outermost is not lane:
                    centres.append(_beside(curve.curve, here, outermost))
        centres = centres or [lanes[1, here]]
        edges[:, here] = (
            np.min(centres, axis=0) - width / 2,
            np.max(centres, axis=0) + width / 2,
        )
    _fill(rows)
    return Corridor(curve, rows, is_open)


def _sections(
    chain: Chain, goal: Goal, until: float
) -> Iterator[tuple[float, tuple[Lane | None, ...]]]:
    """Yield the sections of a route: the way at their end, and the lane left of the
    route, its own, and right of it.

    None stands for a closed lane. A lane beside the route continues as long as it is on
    the route's roads or leads to the goal; otherwise the neighbour of the route's next
    lane follows, unless it is forbidden. Where the route's last lane ends but its
    neighbours continue, the route's own lane is closed from there on; at the end of the
    network, it stays open.
    """
    sides: list[Lane | None] = [None, None]
    for own, end in zip(chain.lanes, chain.starts[1:], strict=True):
        for side, step in enumerate((-1, 1)):
            onward = goal.next(sides[side])
            sibling = own.beside(step)
            joins = onward and (
                onward in own.siblings or onward.end == goal.towards.get(own.start)
            )
            if not joins or onward in chain.lanes:
                onward = None if sibling is None or sibling.forbidden else sibling
            sides[side] = onward
        yield end, (sides[0], own, sides[1])
    last = None if chain.lanes[-1].refuge else chain.lanes[-1]
    way = chain.starts[-1]
    while way < until:
        nexts = [goal.next(side) for side in sides]
        sides = sides if last else nexts
        way += min((lane.length for lane in nexts if lane), default=inf)
        yield way, (sides[0], last, sides[1])


def _fill(rows: Rows) -> None:
    """Replace NaN in rows by interpolation, or by 0 in rows of NaN only."""
    for row in rows:
        known = np.isfinite(row)
        filled = (
            np.interp(np.flatnonzero(~known), np.flatnonzero(known), row[known])
            if known.any()
            else 0.0
        )
        row[~known] = filled


def _outermost(lane: Lane, step: int) -> Lane:
    """Return the last lane to the left (step -1) or to the right (1) before a forbidden
    one.
    """
    other = lane.beside(step)
    return lane if other is None or other.forbidden else _outermost(other, step)


def _beside(curve: Curve, here: slice, lane: Lane) -> Row:
    """Return lateral positions of a lane's centre at some of a curve's samples [m], NaN
    beyond the lane's ends.
    """
    x = curve.x[here]
    y = curve.y[here]
    heading = curve.heading[here]
    ends = sorted(
        lane.shape.local_coordinates(np.array([x[end], y[end]]))[0] for end in (0, -1)
    )
    low = max(ends[0] - LANE_MARGIN, 0.0)
    high = min(ends[1] + LANE_MARGIN, lane.length)
    margin = (
        LANE_PATHS.lane_spacing if lane.length < 2 * LANE_PATHS.lane_spacing else 0.0
    )  # so that there are two samples
    whole = -margin, lane.length + margin
    _, centres, along = samples(
        lane.shape, *((low, high) if high - low > LANE_MARGIN else whole)
    )
    along = np.unwrap(along)
    shape = Curve(
        centres[:, 0],
        centres[:, 1],
        along,
        np.gradient(along, LANE_PATHS.lane_spacing),
        0.0,
        LANE_PATHS.lane_spacing,
    )
    s, d, turned = shape.project(x, y, heading)
    outside = np.maximum(-s, s - shape.end)
    return np.where(
        outside < LANE_EXTENSION,
        -d / np.maximum(np.cos(turned), MIN_LANE_COSINE),
        np.nan,
    )


# Observation

KEPT_BEHIND = 60.0  # m of lanes behind the robot
NEEDED, PLANNED = (
    190.0,
    260.0,
)  # m of lanes ahead: below the first length, they are extended to the second


@dataclass
class Memory:
    """What a robot remembers between observations; stored on the vehicle, so that
    copies of it observe the same.

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
    followed = tuple(
        (start, end) for start, end, _ in getattr(vehicle, "route", None) or ()
    )
    wanted = destination or followed or None
    goal = roads.goal(wanted)
    rear = vehicle.position - vehicle.LENGTH / 2 * vehicle.direction

    # The lanes to follow, and the robot's place on the curve along them.
    ride = None
    if memory.lanes and memory.goal == wanted:
        ride = _continued(vehicle, rear, goal, memory)
    if ride is None:
        chain, way = _begun(vehicle, rear, goal)
        around = corridor(chain, goal, way // Chain.block_length)
        ride = Ride(chain, way, around, _pose_on(around, rear, vehicle, way))
    chain, way, around, (s, d, heading) = ride
    memory.goal = wanted
    memory.lanes = chain.indices
    memory.way = way

    route = paths_from([around.curve], np.array([s]), SHAPE.route_knots)
    changes, room = goal.changes(chain, way + vehicle.LENGTH / 2)
    return RoadScene(
        route=Curve(route.x[0], route.y[0], route.heading[0], route.curvature[0]),
        changes=np.array(changes, np.float32),
        room=np.array(room, np.float32),
        robot=np.array([0.0, d, heading, vehicle.speed], np.float32),
        size=np.array([vehicle.LENGTH, vehicle.WIDTH], np.float32),
        applied=np.array(applied, np.float32),
        **around.at(s - BEHIND + SPACING * np.arange(SHAPE.route_knots)),
        **traffic_of(vehicle, roads, memory.numbers, intentions),
    )


class Ride(NamedTuple):
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


def _pose_on(
    around: Corridor, rear: Point, vehicle: Vehicle, way: float
) -> tuple[float, float, float]:
    """Return s, d and the relative heading of the rear axle on the curve of a route."""
    own = rear[None], np.array([vehicle.heading], dtype=float), np.array([way])
    (s,), (d,), (turned,) = project_cars([around.curve], *own)
    return float(s), float(d), float(turned)


def _continued(
    vehicle: Vehicle, rear: Point, goal: Goal, memory: Memory
) -> Ride | None:
    """Return the lanes to follow and the place on them; None if the robot has changed
    lanes.
    """
    # Where the robot is on the lanes that it has followed so far.
    chain = goal.roads.chain(tuple(goal.roads.lanes[index] for index in memory.lanes))
    block = memory.way // Chain.block_length
    around = corridor(chain, goal, block)
    pose = _pose_on(around, rear, vehicle, memory.way)
    way = around.curve.way(pose[0])
    leg = chain.leg(way + vehicle.LENGTH / 2)
    near = chain.indices[max(leg - 1, 0) : leg + 2]
    index = vehicle.lane_index
    if index not in near and any(other[:2] == index[:2] for other in near):
        return None

    # Extend the lanes before they end.
    if chain.starts[-1] - way <= NEEDED:
        first = chain.leg(way - KEPT_BEHIND)
        onward = goal.ahead(chain.lanes[leg], PLANNED + way - chain.starts[leg])
        way -= chain.starts[first]
        chain = goal.roads.chain(chain.lanes[first:leg] + onward)
    elif way // Chain.block_length == block:
        return Ride(chain, way, around, pose)
    around = corridor(chain, goal, way // Chain.block_length)
    return Ride(chain, way, around, _pose_on(around, rear, vehicle, way))


def _begun(vehicle: Vehicle, rear: Point, goal: Goal) -> tuple[Chain, float]:
    """Return the lanes to follow, beginning behind the robot's present lane, and the
    present way along them.
    """
    lane = goal.roads.lanes[vehicle.lane_index]
    place = float(lane.shape.local_coordinates(rear)[0])
    behind = lane.behind(KEPT_BEHIND - place)
    chain = goal.roads.chain(behind + goal.ahead(lane, PLANNED + place))
    return chain, chain.starts[len(behind)] + place
