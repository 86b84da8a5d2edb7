"""Map a highway-env network: which lanes continue each other, how to reach a goal.

Results are cached.
"""

from bisect import bisect_right
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, wraps
from itertools import accumulate, islice
from math import cos, inf, sin
from typing import Concatenate, NamedTuple, ParamSpec, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

from highway_env.road.lane import AbstractLane
from highway_env.road.road import LaneIndex, RoadNetwork

from ms_highway.geometry.curve import wrapped
from ms_highway.geometry.lane_paths import LANE_PATHS, LaneCurve, join_lanes


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


@dataclass(frozen=True)
class JointSettings:
    """Set which lanes continue each other.

    A joint is where one lane ends and another begins. Widths are those of the first
    lane.
    """

    max_gap: float = 0.5
    """Largest lateral gap at a joint [lane widths]."""
    others_max_gap: float = 0.8
    """The same for other cars [lane widths].

    They take joints that the robot does not, such as exits from inner lanes.
    """
    free_length: float = 10.0
    """Longitudinal gap at a joint that costs nothing [m]."""
    sharpest_turn: float = 2.0
    """Largest turn at a joint [rad]."""
    turn_cost: float = 5.0
    """Lateral gap that counts like a turn of 1 rad at a joint [m]."""


JOINTS = JointSettings()

Owner = TypeVar("Owner")
Rest = ParamSpec("Rest")
Result = TypeVar("Result")


def cached_on_owner(
    function: Callable[Concatenate[Owner, Rest], Result],
) -> Callable[Concatenate[Owner, Rest], Result]:
    """Cache a function's results by its arguments, on its first argument.

    With this argument the results disappear.
    """

    @wraps(function)
    def cached(owner: Owner, *rest: Rest.args, **options: Rest.kwargs) -> Result:
        results: dict[Hashable, Result] = vars(owner).setdefault("_cached", {})
        key = (function.__qualname__, *rest, *sorted(options.items()))
        if key not in results:
            results[key] = function(owner, *rest, **options)
        return results[key]

    return cached


class Lane:
    """A lane of a map.

    Attributes:
        index: in the network.
        shape: the lane of highway-env.
        length: [m].
        limit: speed limit [m/s].
        forbidden: whether highway-env forbids to drive on it.
    """

    default_speed_limit = 20.0
    """Speed limit where a lane has none [m/s]."""
    path_length = 140.0
    """Length of the paths of others along branches [m]."""
    branching_distance = 60.0
    """Distance ahead within which paths of others may branch [m]."""
    rest_unit = 10.0
    """Unit in which the rest of a lane is counted for `branches` [m]."""

    def __init__(self, roads: "RoadMap", index: LaneIndex, shape: AbstractLane) -> None:
        self.roads = roads
        self.index = index
        self.shape = shape
        self.start, self.end, self.number = index
        self.length = float(shape.length)
        self.limit = float(shape.speed_limit or self.default_speed_limit)
        self.forbidden = bool(shape.forbidden)

    def beside(self, steps: int) -> "Lane | None":
        """Return the lane some steps to the right on its road, None without one."""
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

    @cached_on_owner
    def following(self, max_gap: float = JOINTS.max_gap) -> "Lanes":
        """Return the nearest lane of each next road that this lane leads to.

        The one with the smoothest joint comes first.

        Args:
            max_gap: largest lateral gap at a joint [lane widths].
        """
        ends = self.roads.graph.get(self.end, {})
        roads = [self.roads.road(self.end, end) for end in ends]
        nearest = [
            min(road, key=lambda other: other.joints[self].gap) for road in roads
        ]
        leading = [lane for lane in nearest if lane.joints[self].gap < max_gap]
        return tuple(
            sorted(leading, key=lambda other: (other.joints[self].kink, other.index))
        )

    @cached_property
    def preceding(self) -> "Lane | None":
        """The lane that this one continues best."""
        if not self.joints:
            return None
        best = min(self.joints, key=lambda other: self.joints[other].kink)
        return best if self.joints[best].gap < JOINTS.max_gap else None

    @cached_property
    def refuge(self) -> "Lane | None":
        """The nearest lane of the same road that continues although this one ends.

        None without one, or where this lane continues.
        """
        if self.following():
            return None
        continuing = [other for other in self.siblings if other.following()]
        return min(
            continuing, key=lambda other: abs(other.number - self.number), default=None
        )

    def behind(self, length: float) -> "Lanes":
        """Return lanes that lead to this one, over a length [m] if there are enough."""
        before = self.preceding
        if not before or length <= 0:
            return ()
        return (*before.behind(length - before.length), before)

    @cached_on_owner
    def branches(self, rest: int) -> "list[Chain]":
        """Return the chains from a place on this lane on, one for each branch.

        Args:
            rest: length from the place to the lane's end, in whole ``rest_unit``.
        """
        found: list[Chain] = []
        open_ends: list[tuple[Lanes, float]] = [((self,), self.rest_unit * rest)]
        for lanes, covered in open_ends:
            following: Lanes = ()
            if covered < self.path_length:
                following = lanes[-1].following(JOINTS.others_max_gap)
            if not following:
                found.append(self.roads.chain(lanes))

            # Far ahead, only the smoothest joint is taken.
            if covered >= self.branching_distance:
                following = following[:1]
            for lane in following:
                open_ends.append(((*lanes, lane), covered + lane.length))
        return found


Lanes: TypeAlias = tuple[Lane, ...]


class Joint(NamedTuple):
    """How a lane continues another one.

    Attributes:
        gap: lateral gap between the end of one and the beginning of the other, in
            widths of a lane. It is measured across the mean of both headings, along
            which the chord of an arc that touches both lanes lies.
        kink: how far the joint is from smooth [m].
    """

    gap: float
    kink: float


def _joint(one: AbstractLane, other: AbstractLane) -> Joint:
    """Return how a lane continues another one."""
    x, y = other.position(0.0, 0.0) - one.position(one.length, 0.0)
    before = one.heading_at(one.length)
    width = float(one.width_at(one.length))
    turn = wrapped(other.heading_at(0.0) - before)

    # Gaps along and across the mean of both headings; long ones along it count, too.
    mean = before + turn / 2
    gap = abs(cos(mean) * y - sin(mean) * x)
    gap += max(abs(cos(mean) * x + sin(mean) * y) - JOINTS.free_length, 0.0)
    if abs(turn) > JOINTS.sharpest_turn:
        gap += inf

    # The turn some metres later tells lanes apart that begin in the same direction.
    later_heading = other.heading_at(min(other.length, JOINTS.free_length))
    later_turn = wrapped(later_heading - before)
    turns = abs(turn) + abs(later_turn) / 10
    return Joint(gap / width, gap + JOINTS.turn_cost * turns)


class Chain:
    """Lanes that continue each other.

    A way is a distance along them from the beginning of the first [m].

    Attributes:
        lanes: in order.
        indices: of the lanes in the network.
        starts: ways at which the lanes begin, and at which the last one ends.
    """

    block_length = 100.0
    """Length of the blocks in which long chains of lanes are sampled [m]."""
    before_block = 70.0
    """Length that is sampled before a block [m]."""
    after_block = 260.0
    """Length that is sampled after a block [m]."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self.indices = tuple(lane.index for lane in lanes)
        self.starts = [0.0, *accumulate(lane.length for lane in lanes)]

    def leg(self, way: float) -> int:
        """Return the number of the lane at a way."""
        return bisect_right(self.starts, way, 1, len(self.lanes)) - 1

    @cached_on_owner
    def curve(
        self,
        block: float,
        widths: tuple[float, ...] = LANE_PATHS.widths,
        within: float = inf,
    ) -> LaneCurve:
        """Return the curve along the lanes near a block, by its number.

        See `join_lanes` for ``widths`` and ``within``.
        """
        low = block * self.block_length - self.before_block
        high = (block + 1) * self.block_length + self.after_block
        shapes = [lane.shape for lane in self.lanes]
        return join_lanes(shapes, self.starts, low, high, widths, within)


class Goal:
    """A destination, and the roads that lead there.

    Attributes:
        towards: the next node on the way to the destination, by node.
        spot: the destination if it is a spot, otherwise None.
    """

    max_roads = 50
    """Number of roads that a goal looks ahead."""

    def __init__(self, roads: "RoadMap", destination: Destination) -> None:
        self.roads = roads
        self.spot = destination if isinstance(destination, Spot) else None
        last = destination.lane[1] if isinstance(destination, Spot) else destination
        self.towards: dict[str, str] = {}
        if not isinstance(last, str):
            self.towards = dict(last or ())  # roads to follow
            return

        # Search backwards from the last node, by the number of roads.
        queue = [last]
        for node in queue:
            for start, ends in roads.graph.items():
                if node in ends and start not in self.towards and start != last:
                    self.towards[start] = node
                    queue.append(start)

    def next(self, lane: Lane | None) -> Lane | None:
        """Return the next lane, towards the goal if this lane leads there.

        None where the lane ends.
        """
        if lane is None:
            return None
        wanted = self.towards.get(lane.end)
        return min(
            lane.following(),
            key=lambda other: (other.end != wanted, other.forbidden),
            default=None,
        )

    def lanes_from(self, lane: Lane) -> Iterator[Lane]:
        """Yield a lane and the next ones."""
        following: Lane | None = lane
        while following:
            yield following
            following = self.next(following)

    def ahead(self, lane: Lane, length: float) -> Lanes:
        """Return a lane and the next ones, over a length [m] if there are enough."""
        lanes = []
        covered = 0.0
        for own in self.lanes_from(lane):
            lanes.append(own)
            covered += own.length
            if covered >= length:
                break
        return tuple(lanes)

    @cached_on_owner
    def demand(self, lane: Lane) -> tuple[int, float]:
        """Return the lane changes to the right that the goal asks for, and their room.

        The room is the distance to make them, from the beginning of the lane [m].
        Changes are needed before the end of the first road on which the followed lane
        does not lead to the next road, towards the goal if there is one, while other
        lanes do. A spot has to be reached on its own lane.
        """
        passed = 0.0
        for own in islice(self.lanes_from(lane), self.max_roads):
            if self.spot and own.index[:2] == self.spot.lane[:2]:
                return self.spot.lane[2] - own.number, passed + self.spot.place

            passed = passed + own.length
            wanted = self.towards.get(own.end)
            leading = [other for other in own.siblings if self._leads_to(other, wanted)]
            if not leading:
                break
            if own not in leading:
                changes = [other.number - own.number for other in leading]
                return min(changes, key=abs), passed
        return 0, inf

    @staticmethod
    def _leads_to(lane: Lane, node: str | None) -> bool:
        """Return whether a lane leads to a node by the next road, None for any node."""
        return any(node in (None, following.end) for following in lane.following())

    def changes(self, chain: Chain, way: float) -> tuple[list[int], float]:
        """Return the lane changes to the right from three lanes, and the room for them.

        The lanes are those to the left, of the chain itself, and to the right. The
        changes are those that the goal asks for.

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
                if not needed:
                    until = min(until, end)
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

    @cached_on_owner
    def road(self, start: str, end: str) -> Lanes:
        """Return the lanes between two nodes, from left to right."""
        return tuple(
            self.lanes[start, end, number]
            for number in range(len(self.graph[start][end]))
        )

    @cached_on_owner
    def chain(self, lanes: Lanes) -> Chain:
        """Return the chain of some lanes."""
        return Chain(lanes)

    @cached_on_owner
    def goal(self, destination: Destination) -> Goal:
        """Return the goal of a destination."""
        return Goal(self, destination)

    def branches(self, spots: Sequence[tuple[Lane, float]]) -> list[list[Chain]]:
        """Return the branches from each place on a lane [m], as chains."""
        found = []
        for lane, place in spots:
            rest = max(lane.length - place, 0.0)
            found.append(lane.branches(int(rest // lane.rest_unit)))
        return found

    def curves(self, spots: Sequence[tuple[Chain, float]]) -> list[LaneCurve]:
        """Return the curve along each chain of lanes near a way along it [m]."""
        return [chain.curve(way // chain.block_length) for chain, way in spots]


# Copies of a network get maps of their own.
_maps: WeakKeyDictionary[RoadNetwork, RoadMap] = WeakKeyDictionary()


def road_map(network: RoadNetwork) -> RoadMap:
    """Return the map of a network, which is made once."""
    if network not in _maps:
        _maps[network] = RoadMap(network)
    return _maps[network]
