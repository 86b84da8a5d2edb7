"""Measure the lanes beside a route: where they are, where they may be driven on, and where the road's edges are."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from ms_highway.game.road import LANES
from ms_highway.vehicle.lane_paths import FINE, Curve, samples
from ms_highway.vehicle.road_map import BLOCK, LIMIT, Chain, Goal, LaneIndex, RoadMap

__all__ = ["Corridor", "corridor"]

AROUND = 6.0  # m, that lanes are sampled farther than the route beside them
BEYOND = 3.0  # m, up to which a lane is taken to go straight on
NEARBY = 2.0  # widths of a lane, up to which a lane that leads elsewhere can be changed to


@dataclass(frozen=True)
class Corridor:
    """A route's curve and, at its samples, the road around it.

    Attributes:
        curve: of the route.
        lanes: lateral positions of the lanes left of it, on it, right of it [m].
        open: where they may be driven on.
        edges: lateral positions of the road's edges [m].
        limit: speed limit [m/s].
    """

    curve: Curve
    lanes: Float[np.ndarray, "lanes samples"]
    open: Bool[np.ndarray, "lanes samples"]
    edges: Float[np.ndarray, "2 samples"]
    limit: Float[np.ndarray, "samples"]

    def at(self, s: Float[np.ndarray, "knots"]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return lanes, open, edges and limit at distances from the curve's beginning [m]."""
        numbers = np.concatenate([self.lanes, self.edges, self.limit[None]])
        rows = self.curve.gather(numbers, s).astype(np.float32)
        nearest = np.clip(np.round(s / FINE).astype(int), 0, self.limit.size - 1)
        return rows[:LANES], self.open[:, nearest], rows[LANES : LANES + 2], rows[-1]


@dataclass(frozen=True)
class _Section:
    """Lanes between two ways of a route: left of it, its own, right of it; None where there is none to drive on."""

    low: float
    high: float
    lanes: tuple[LaneIndex | None, LaneIndex | None, LaneIndex | None]


def corridor(roads: RoadMap, chain: Chain, goal: Goal, way: float) -> Corridor:
    """Return what is around the route along a chain of lanes near a way [m], computed once."""
    key = (chain, goal, way // BLOCK)
    if key not in roads.kept:
        roads.kept[key] = _measure(roads, roads.curve(chain, way), chain, goal)
    return roads.kept[key]  # type: ignore[return-value]


def _sections(roads: RoadMap, chain: Chain, goal: Goal, until: float) -> list[_Section]:
    """Return the sections of a route.

    A lane beside the route goes on as that lane does, also where it alone leads to the goal; another one begins where
    the route's road has a lane there that is not forbidden. A lane of the route that ends while others beside it go on
    cannot be driven on from there, one at the end of the network can.
    """
    sections, starts = [], roads.starts(chain)
    sides: list[LaneIndex | None] = [None, None]
    for number, own in enumerate(chain):
        for side, step in enumerate((-1, 1)):
            last = sides[side]
            onward = roads.following_towards(last, goal) if last else None
            sibling = roads.beside(own, step)
            wanted = roads.towards(goal).get(own[0])
            if onward in chain or (onward and onward[:2] != own[:2] and onward[1] != wanted):
                onward = None
            if onward is None and sibling is not None and not roads.forbidden(sibling):
                onward = sibling
            sides[side] = onward
        sections.append(_Section(starts[number], starts[number + 1], (sides[0], own, sides[1])))
    own_goes_on = None if roads.refuge(chain[-1]) else chain[-1]
    way = starts[-1]
    while way < until:
        nexts = [roads.following_towards(side, goal) if side else None for side in sides]
        sides = sides if own_goes_on else nexts
        length = min((roads.lanes[side].length for side in nexts if side), default=np.inf)
        sections.append(_Section(way, way + length, (sides[0], own_goes_on, sides[1])))
        way += length
    return sections


def _measure(roads: RoadMap, curve: Curve, chain: Chain, goal: Goal) -> Corridor:
    ways = curve.samples[4]
    count = ways.size
    lanes, is_open = np.zeros((LANES, count)), np.zeros((LANES, count), dtype=bool)
    edges, limit = np.zeros((2, count)), np.full(count, LIMIT)
    sections = _sections(roads, chain, goal, ways[-1])
    for number, section in enumerate(sections):
        low = 0 if number == 0 else int(np.searchsorted(ways, section.low))
        high = int(np.searchsorted(ways, section.high))
        if high <= low:
            continue
        here = slice(low, high)
        own = section.lanes[1]
        width = float(roads.lanes[own or chain[-1]].width_at(0.0))
        lanes[:, here] = np.array([[-width], [0.0], [width]])
        found = []
        for place, index in enumerate(section.lanes):
            if index is None:
                continue
            beside = _beside(roads, curve, here, index) if place != 1 else lanes[place, here]
            lanes[place, here] = beside
            is_open[place, here] = ~(np.abs(beside) >= NEARBY * width)
            found.append(np.where(is_open[place, here], beside, 0.0))
        found += [_beside(roads, curve, here, index) for index in _outermost(roads, section)]
        found = found or [lanes[1, here]]
        edges[0, here] = np.min(found, axis=0) - width / 2
        edges[1, here] = np.max(found, axis=0) + width / 2
        reference = own or section.lanes[0] or section.lanes[2] or chain[-1]
        limit[here] = roads.limit(reference)
    return Corridor(curve, _bridged(lanes), is_open, _bridged(edges), limit)


def _bridged(rows: Float[np.ndarray, "rows samples"]) -> Float[np.ndarray, "rows samples"]:
    """Interpolate where numbers are missing; without any, return zeros."""
    places, known = np.arange(rows.shape[1]), np.isfinite(rows)
    return np.stack(
        [
            np.interp(places, places[there], row[there]) if there.any() else 0 * places
            for row, there in zip(rows, known, strict=True)
        ]
    )


def _outermost(roads: RoadMap, section: _Section) -> list[LaneIndex]:
    """Return the lanes on both sides of a road that are reached over lanes that are not forbidden."""
    found = []
    for place, step in ((0, -1), (2, 1)):
        index = section.lanes[place]
        while index and (other := roads.beside(index, step)) is not None and not roads.forbidden(other):
            index = other
        if index and index != section.lanes[place]:
            found.append(index)
    return found


def _beside(roads: RoadMap, curve: Curve, here: slice, index: LaneIndex) -> Float[np.ndarray, "samples"]:
    """Return lateral positions of a lane's centre at some of a curve's samples [m], NaN before and after it."""
    lane = roads.lanes[index]
    x, y, heading = curve.samples[:3, here]
    first, last = (lane.local_coordinates(np.array([x[end], y[end]]))[0] for end in (0, -1))
    low, high = max(min(first, last) - AROUND, 0.0), min(max(first, last) + AROUND, lane.length)
    _, points, along = samples(lane, *((low, high) if high - low > AROUND else (0.0, lane.length)))
    here_points = np.stack([x, y], axis=-1)
    _, nearest = cKDTree(points).query(here_points)
    delta = points[nearest] - here_points
    cosine, sine = np.cos(heading), np.sin(heading)
    ahead, aside = cosine * delta[:, 0] + sine * delta[:, 1], cosine * delta[:, 1] - sine * delta[:, 0]
    lateral = aside - ahead * np.clip(np.tan(along[nearest] - heading), -1.0, 1.0)
    return np.where(np.abs(ahead) < BEYOND, lateral, np.nan)
