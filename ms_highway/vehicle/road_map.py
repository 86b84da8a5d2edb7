"""Find which lanes follow which in a highway-env network, keeping what has been computed."""

from bisect import bisect_right
from collections.abc import Hashable, Mapping
from functools import cache, cached_property
from math import cos, inf, sin
from typing import TypeAlias
from weakref import WeakKeyDictionary

from highway_env.road.lane import AbstractLane
from highway_env.road.road import RoadNetwork

from ms_highway.game.road import wrapped
from ms_highway.vehicle.lane_paths import Curve, join_lanes, starts_of

__all__ = ["LIMIT", "Chain", "Goal", "LaneIndex", "RoadMap", "road_map"]

LaneIndex: TypeAlias = tuple[str, str, int]
Chain: TypeAlias = tuple[LaneIndex, ...]
"""Lanes, each of which follows the one before."""

Goal: TypeAlias = str | tuple[tuple[str, str], ...] | None
"""A node to reach, or roads to follow where they begin, or none."""

LIMIT = 20.0
"""Speed limit where a lane has none [m/s]."""

REACH = 0.5  # widths of a lane, sideways at a joint, up to which a lane leads to the next
BRIDGED = 10.0  # m, along the lane at a joint
SHARPEST_TURN = 2.0  # rad, at a joint
TURN = 5.0  # m of a jump that one radian of a jump in heading is worth
BLOCK = 100.0  # m, in steps of which long lanes are sampled
BEFORE, AFTER = 70.0, 260.0  # m, sampled before and after a block


class RoadMap:
    """The lanes of a network and what follows from them alone, computed once."""

    def __init__(self, graph: Mapping[str, Mapping[str, list[AbstractLane]]]) -> None:
        self.graph = graph
        self.kept: dict[Hashable, object] = {}
        self.joint = cache(self._joint)
        self.following = cache(self._following)
        self.towards = cache(self._towards)
        self.demand = cache(self._demand)
        self.refuge = cache(self._refuge)
        self.starts = cache(self._starts)
        self.joined = cache(self._joined)

    @cached_property
    def lanes(self) -> dict[LaneIndex, AbstractLane]:
        """All lanes by their index."""
        return {
            (start, end, number): lane
            for start, ends in self.graph.items()
            for end, lanes in ends.items()
            for number, lane in enumerate(lanes)
        }

    @cached_property
    def entering(self) -> dict[str, list[LaneIndex]]:
        """Lanes that end at each node."""
        found: dict[str, list[LaneIndex]] = {}
        for index in self.lanes:
            found.setdefault(index[1], []).append(index)
        return found

    def beside(self, index: LaneIndex, steps: int) -> LaneIndex | None:
        """Return the lane of the same road some lanes to the right, None without one."""
        other = (*index[:2], index[2] + steps)
        return other if other in self.lanes else None

    def forbidden(self, index: LaneIndex) -> bool:
        """Return whether changes to a lane are forbidden."""
        return bool(self.lanes[index].forbidden)

    def limit(self, index: LaneIndex) -> float:
        """Return the speed limit of a lane [m/s]."""
        return float(self.lanes[index].speed_limit or LIMIT)

    def _joint(self, index: LaneIndex, following: LaneIndex) -> tuple[float, float]:
        """Return how far a lane begins beside the end of another, in widths, and how unevenly it continues it [m].

        Beside is measured across the mean of both headings: an arc that touches both lanes has its chord along it.
        """
        one, other = self.lanes[index], self.lanes[following]
        x, y = other.position(0.0, 0.0) - one.position(one.length, 0.0)
        before = one.heading_at(one.length)
        turn = wrapped(other.heading_at(0.0) - before)
        mean = before + turn / 2
        aside = abs(cos(mean) * y - sin(mean) * x)
        aside += max(abs(cos(mean) * x + sin(mean) * y) - BRIDGED, 0.0) + (inf if abs(turn) > SHARPEST_TURN else 0.0)
        later = wrapped(other.heading_at(min(other.length, BRIDGED)) - before)
        return aside / float(one.width_at(one.length)), aside + TURN * (abs(turn) + abs(later) / 10)

    def _following(self, index: LaneIndex, reach: float = REACH) -> Chain:
        """Return the nearest lane of each next road that a lane leads to, the most even one first."""
        found = []
        for end, lanes in self.graph.get(index[1], {}).items():
            nexts = [(index[1], end, number) for number in range(len(lanes))]
            nearest = min(nexts, key=lambda other: self.joint(index, other)[0])
            aside, kink = self.joint(index, nearest)
            if aside < reach:
                found.append((kink, nearest))
        return tuple(lane for _, lane in sorted(found))

    def following_towards(self, index: LaneIndex, goal: Goal) -> LaneIndex | None:
        """Return the lane to follow next: towards the goal if this lane leads there, None where a lane ends."""
        wanted = self.towards(goal).get(index[1])
        return min(
            self.following(index),
            key=lambda other: (other[1] != wanted, self.forbidden(other)),
            default=None,
        )

    def preceding(self, index: LaneIndex) -> LaneIndex | None:
        """Return the lane that a lane continues best."""
        found = [(self.joint(other, index), other) for other in self.entering.get(index[0], ())]
        (aside, _), best = min(found, key=lambda item: item[0][1], default=((inf, inf), None))
        return best if aside < REACH else None

    def continues_best(self, index: LaneIndex, following: LaneIndex) -> bool:
        """Return whether no lane leads to another clearly more evenly than this one; who joins gives way."""
        kinks = [self.joint(other, following)[1] for other in self.entering.get(following[0], ())]
        return self.joint(index, following)[1] < min(kinks) + 0.5

    def _towards(self, goal: Goal) -> dict[str, str]:
        """Return the node to go to from each node from which the goal can be reached."""
        if goal is None:
            return {}
        if not isinstance(goal, str):
            return dict(goal)
        found: dict[str, str] = {}
        queue = [goal]
        for node in queue:
            for start, ends in self.graph.items():
                if node in ends and start not in found and start != goal:
                    found[start] = node
                    queue.append(start)
        return found

    def ahead(self, index: LaneIndex, goal: Goal, length: float) -> Chain:
        """Return a lane and those that follow it, over at least a length [m] as far as there are lanes."""
        chain, covered = [index], float(self.lanes[index].length)
        while covered < length and (following := self.following_towards(chain[-1], goal)) is not None:
            chain.append(following)
            covered += float(self.lanes[following].length)
        return tuple(chain)

    def behind(self, index: LaneIndex, length: float) -> Chain:
        """Return lanes that lead to a lane, over at least a length [m] as far as there are any."""
        chain, covered = [index], 0.0
        while covered < length and (before := self.preceding(chain[0])) is not None:
            chain.insert(0, before)
            covered += float(self.lanes[before].length)
        return tuple(chain[:-1])

    def _refuge(self, index: LaneIndex) -> LaneIndex | None:
        """Return the nearest lane of the same road that goes on where this one ends, None if it does not."""
        if self.following(index):
            return None
        onward = [other for other in self._road(index) if self.following(other)]
        return min(onward, key=lambda other: abs(other[2] - index[2]), default=None)

    def _road(self, index: LaneIndex) -> Chain:
        return tuple((*index[:2], number) for number in range(len(self.graph[index[0]][index[1]])))

    def _demand(self, index: LaneIndex, goal: Goal) -> tuple[int, float]:
        """Return changes of lane to the right that are needed and the distance from the lane's beginning for them.

        They are needed before the end of the first road from whose lane, followed from here, the next road towards
        the goal, or without one any road, is out of reach while other lanes lead there.
        """
        passed, towards = 0.0, self.towards(goal)
        for _ in range(50):
            passed += float(self.lanes[index].length)
            wanted = towards.get(index[1])
            leading = [
                other
                for other in self._road(index)
                if any(wanted in (None, following[1]) for following in self.following(other))
            ]
            if not leading:
                break
            if index not in leading:
                return min((other[2] - index[2] for other in leading), key=abs), passed
            following = self.following_towards(index, goal)
            if following is None:
                break
            index = following
        return 0, inf

    def _starts(self, chain: Chain) -> list[float]:
        """Return the way along a chain at which each of its lanes begins, and its end [m]."""
        return starts_of([self.lanes[index] for index in chain])

    def leg(self, chain: Chain, way: float) -> int:
        """Return the number of the lane of a chain at a way [m]."""
        return min(max(bisect_right(self.starts(chain), way) - 1, 0), len(chain) - 1)

    def curve(self, chain: Chain, way: float) -> Curve:
        """Return the curve along a chain near a way [m]."""
        return self.joined(chain, way // BLOCK)

    def _joined(self, chain: Chain, block: float) -> Curve:
        low, high = block * BLOCK - BEFORE, (block + 1) * BLOCK + AFTER
        return join_lanes([self.lanes[index] for index in chain], low, high)


_maps: WeakKeyDictionary[RoadNetwork, RoadMap] = WeakKeyDictionary()


def road_map(network: RoadNetwork) -> RoadMap:
    """Return the map of a network, the same one as long as it lives."""
    if network not in _maps:
        _maps[network] = RoadMap(network.graph)
    return _maps[network]
