"""Map a highway-env network: which lanes continue each other, and how to reach a goal.
Results are cached.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, wraps
from itertools import accumulate, islice
from math import cos, inf, sin
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast
from weakref import WeakKeyDictionary

from highway_env.road.lane import AbstractLane
from highway_env.road.road import LaneIndex, RoadNetwork

from ms_highway.geometry.curve import wrapped
from ms_highway.geometry.lane_paths import SMOOTHING, LaneCurve, join_lanes


class Spot(NamedTuple):
    """A place on a lane.

    Attributes:
        lane: index of the lane.
        place: position along the lane [m].
    """

    lane: LaneIndex
    place: float


Destination: TypeAlias = str | Spot | tuple[tuple[str, str], ...] | None
"""A node to reach, a spot on a lane, roads to follow from their beginnings on, or None.
"""

LIMIT = 20.0
"""Speed limit where a lane has none [m/s]."""

BLOCK = 100.0
"""Length of the blocks in which long chains of lanes are sampled [m]."""

REACH = 0.5  # widths of a lane: largest lateral gap at a joint of lanes
BRIDGED = 10.0  # m, longitudinal gap at a joint that costs nothing
SHARPEST_TURN = 2.0  # rad, at a joint
TURN = 5.0  # lateral gap that counts like a turn of 1 rad at a joint [m]
BEFORE, AFTER = 70.0, 260.0  # m, sampled before and after a block
MAX_ROADS = 50  # that a goal looks ahead
# widths of a lane: others take joints that the robot does not, such as exits from inner
# lanes
CROOKED = 0.8
BRANCHING_DISTANCE = 60.0  # m ahead within which paths of others may branch
PATH_LENGTH = 140.0  # m, of paths of others
TENS = 10.0  # m, resolution of the rest of a lane

Function = TypeVar("Function", bound=Callable[..., Any])


def kept(function: Function) -> Function:
    """Cache a function's results by its arguments, on its first argument, with which
    they disappear.
    """

    @wraps(function)
    def remembered(owner: Any, *rest: Any) -> Any:
        results = vars(owner).setdefault("_kept", {})
        key = (function.__qualname__, *rest)
        if key not in results:
            results[key] = function(owner, *rest)
        return results[key]

    return cast(Function, remembered)


class Lane:
    """A lane of a map.

    Attributes:
        index: in the network.
        shape: the lane of highway-env.
        length: [m].
        limit: speed limit [m/s].
    """

    def __init__(self, roads: "RoadMap", index: LaneIndex, shape: AbstractLane) -> None:
        self.roads = roads
        self.index = index
        self.shape = shape
        self.start, self.end, self.number = index
        self.length = float(shape.length)
        self.limit = float(shape.speed_limit or LIMIT)
        self.forbidden = bool(shape.forbidden)

    def beside(self, steps: int) -> "Lane | None":
        """Return the lane that is some steps to the right on the same road, None
        without one.
        """
        return self.roads.lanes.get((self.start, self.end, self.number + steps))

    @property
    def siblings(self) -> "Lanes":
        """All lanes of its road."""
        return self.roads.road(self.start, self.end)

    @cached_property
    def joints(self) -> "dict[Lane, Joint]":
        """How this lane continues each lane before it."""
        return {
            lane: _joint(lane.shape, self.shape)
            for lane in self.roads.lanes.values()
            if lane.end == self.start
        }

    @kept
    def following(self, reach: float = REACH) -> "Lanes":
        """Return the nearest lane of each next road that this lane leads to, the
        smoothest joint first.
        """
        roads = [
            self.roads.road(self.end, end) for end in self.roads.graph.get(self.end, {})
        ]
        nearest = [
            min(road, key=lambda other: other.joints[self].aside) for road in roads
        ]
        leading = [lane for lane in nearest if lane.joints[self].aside < reach]
        return tuple(
            sorted(leading, key=lambda other: (other.joints[self].kink, other.index))
        )

    @cached_property
    def preceding(self) -> "Lane | None":
        """The lane that this one continues best."""
        best = min(self.joints, key=lambda other: self.joints[other].kink, default=None)
        return best if best and self.joints[best].aside < REACH else None

    @cached_property
    def refuge(self) -> "Lane | None":
        """The nearest lane of the same road that continues although this one ends, None
        without one.
        """
        onward = (
            ()
            if self.following()
            else [other for other in self.siblings if other.following()]
        )
        return min(
            onward, key=lambda other: abs(other.number - self.number), default=None
        )

    def behind(self, length: float) -> "Lanes":
        """Return lanes that lead to this one, over a length [m] if there are enough."""
        before = self.preceding
        return (
            (*before.behind(length - before.length), before)
            if before and length > 0
            else ()
        )

    @kept
    def branches(self, tens: int) -> "list[Chain]":
        """Return the chains from some tens of metres before the lane's end on, one for
        each branch.
        """
        found: list[Chain] = []
        open_ends: list[tuple[Lanes, float]] = [((self,), TENS * tens)]
        for lanes, covered in open_ends:
            nexts = lanes[-1].following(CROOKED) if covered < PATH_LENGTH else ()
            onward = nexts if covered < BRANCHING_DISTANCE else nexts[:1]
            for following in onward:
                open_ends.append(((*lanes, following), covered + following.length))
            if not nexts:
                found.append(self.roads.chain(lanes))
        return found


Lanes: TypeAlias = tuple[Lane, ...]


class Joint(NamedTuple):
    """How a lane continues another one.

    Attributes:
        aside: lateral gap between the end of one and the beginning of the other, in
            widths of a lane. It is measured across the mean of both headings, along
            which the chord of an arc that touches both lanes lies.
        kink: how far the joint is from smooth [m].
    """

    aside: float
    kink: float


def _joint(one: AbstractLane, other: AbstractLane) -> Joint:
    x, y = other.position(0.0, 0.0) - one.position(one.length, 0.0)
    before = one.heading_at(one.length)
    width = float(one.width_at(one.length))
    turn = wrapped(other.heading_at(0.0) - before)
    mean = before + turn / 2
    aside = abs(cos(mean) * y - sin(mean) * x)
    aside += max(abs(cos(mean) * x + sin(mean) * y) - BRIDGED, 0.0) + (
        inf if abs(turn) > SHARPEST_TURN else 0.0
    )
    later = wrapped(other.heading_at(min(other.length, BRIDGED)) - before)
    return Joint(aside / width, aside + TURN * (abs(turn) + abs(later) / 10))


class Chain:
    """Lanes that continue each other. A way is a distance along them from the beginning
    of the first [m].

    Attributes:
        lanes: in order.
        indices: of the lanes in the network.
        starts: ways at which the lanes begin, and at which the last one ends.
    """

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self.indices = tuple(lane.index for lane in lanes)
        self.starts = [0.0, *accumulate(lane.length for lane in lanes)]

    def leg(self, way: float) -> int:
        """Return the number of the lane at a way."""
        return bisect_right(self.starts, way, 1, len(self.lanes)) - 1

    @kept
    def curve(
        self, block: float, widths: tuple[float, ...] = SMOOTHING, within: float = inf
    ) -> LaneCurve:
        """Return the curve along the lanes near a block, by its number; see
        `join_lanes` for smoothing.
        """
        low = block * BLOCK - BEFORE
        high = (block + 1) * BLOCK + AFTER
        shapes = [lane.shape for lane in self.lanes]
        return join_lanes(shapes, self.starts, low, high, widths, within)


class Goal:
    """A destination, and the roads that lead there.

    Attributes:
        towards: the next node on the way to the destination, by node.
        spot: the destination if it is a spot, otherwise None.
    """

    def __init__(self, roads: "RoadMap", destination: Destination) -> None:
        self.roads = roads
        self.spot = destination if isinstance(destination, Spot) else None
        last = destination.lane[1] if isinstance(destination, Spot) else destination
        self.towards: dict[str, str] = {} if isinstance(last, str) else dict(last or ())
        queue = [last] if isinstance(last, str) else []
        for node in queue:
            for start, ends in roads.graph.items():
                if node in ends and start not in self.towards and start != last:
                    self.towards[start] = node
                    queue.append(start)

    def next(self, lane: Lane | None) -> Lane | None:
        """Return the next lane, towards the goal if this lane leads there; None where
        the lane ends.
        """
        wanted = lane and self.towards.get(lane.end)
        nexts = lane.following() if lane else ()
        return min(
            nexts,
            key=lambda other: (other.end != wanted, other.forbidden),
            default=None,
        )

    def onward(self, lane: Lane) -> Iterator[Lane]:
        """Yield a lane and the next ones."""
        following: Lane | None = lane
        while following:
            yield following
            following = self.next(following)

    def ahead(self, lane: Lane, length: float) -> Lanes:
        """Return a lane and the next ones, over a length [m] if there are enough."""
        lanes = []
        covered = 0.0
        for own in self.onward(lane):
            lanes.append(own)
            covered += own.length
            if covered >= length:
                break
        return tuple(lanes)

    @kept
    def demand(self, lane: Lane) -> tuple[int, float]:
        """Return the number of lane changes to the right that the goal asks for, and
        the distance to make them.

        The distance is from the beginning of the lane [m]. Changes are needed before
        the end of the first road on which the followed lane does not lead to the next
        road, towards the goal if there is one, while other lanes do. A spot has to be
        reached on its own lane.
        """
        passed = 0.0
        for own in islice(self.onward(lane), MAX_ROADS):
            if self.spot and own.index[:2] == self.spot.lane[:2]:
                return self.spot.lane[2] - own.number, passed + self.spot.place
            passed = passed + own.length
            wanted = self.towards.get(own.end)
            leading = [
                other
                for other in own.siblings
                if any(wanted in (None, onward.end) for onward in other.following())
            ]
            if leading and own not in leading:
                return (
                    min((other.number - own.number for other in leading), key=abs),
                    passed,
                )
            if not leading:
                break
        return 0, inf

    def changes(self, chain: Chain, way: float) -> tuple[list[int], float]:
        """Return the lane changes to the right that the goal asks for from three lanes,
        and the room for them.

        The lanes are those to the left, of the chain itself, and to the right.

        Args:
            chain: lanes that a car follows.
            way: position of the car along them [m].
        """
        leg = chain.leg(way)
        own = chain.lanes[leg]
        needed, until = self.demand(own)

        # From a side where there is no lane, as from the own lane.
        changes = [needed + 1, needed, needed - 1]
        for place, side in ((0, -1), (2, 1)):
            lane = own.beside(side)
            if lane:
                changes[place], end = self.demand(lane)
                until = until if needed else min(until, end)
        return changes, max(until - (way - chain.starts[leg]), 0.0)


class RoadMap:
    """The lanes of a network.

    Attributes:
        lanes: by their index.
    """

    def __init__(self, network: RoadNetwork) -> None:
        self.graph = network.graph
        self.lanes = {
            index: Lane(self, index, shape)
            for index, shape in network.lanes_dict().items()
        }

    @kept
    def road(self, start: str, end: str) -> Lanes:
        """Return the lanes between two nodes, from left to right."""
        return tuple(
            self.lanes[start, end, number]
            for number in range(len(self.graph[start][end]))
        )

    @kept
    def chain(self, lanes: Lanes) -> Chain:
        """Return the chain of some lanes."""
        return Chain(lanes)

    @kept
    def goal(self, destination: Destination) -> Goal:
        """Return the goal of a destination."""
        return Goal(self, destination)

    def branches(self, spots: Sequence[tuple[Lane, float]]) -> list[list[Chain]]:
        """Return, for each place on a lane [m], the chains from there on, one for each
        branch.
        """
        found = []
        for lane, place in spots:
            rest = max(lane.length - place, 0.0)
            found.append(lane.branches(int(rest // TENS)))
        return found

    def curves(self, spots: Sequence[tuple[Chain, float]]) -> list[LaneCurve]:
        """Return the curve along each chain of lanes near a way along it [m]."""
        return [chain.curve(way // BLOCK) for chain, way in spots]


_maps: WeakKeyDictionary[RoadNetwork, RoadMap] = (
    WeakKeyDictionary()
)  # copies of a network get maps of their own


def road_map(network: RoadNetwork) -> RoadMap:
    """Return the map of a network, which is made once."""
    if network not in _maps:
        _maps[network] = RoadMap(network)
    return _maps[network]
