"""Measure the lanes beside a route: where they are, where they may be driven on, and where the road's edges are."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np
from jaxtyping import Bool

from ms_highway.geometry.curve import Curve, Rows
from ms_highway.geometry.lane_paths import COARSE, FINE, LaneCurve, Row, samples
from ms_highway.geometry.road_map import Chain, Goal, Lane, kept
from ms_highway.perception.scene import LANES

LANE_MARGIN = 6.0  # m, that lanes are sampled farther than the route beside them
MIN_LANE_COSINE = 0.7  # cosine of the angle between a lane and the route, below which it counts as this
LANE_EXTENSION = 3.0  # m, up to which a lane is taken to go straight on
DRIVEN = (6.0,)  # m, over which a route is smoothed: it cuts the corners of joints by up to 0.6 m
NEARBY = 2.0  # widths of a lane, up to which a lane that leads elsewhere can be changed to


@dataclass(frozen=True)
class Corridor:
    """A route's curve and, at its samples, the road around it.

    Attributes:
        curve: of the route.
        rows: lateral positions of the lanes left of it, on it, right of it, and of the road's edges [m].
        open: where the lanes may be driven on.
    """

    curve: LaneCurve
    rows: Rows
    open: Bool[np.ndarray, "lanes samples"]

    def at(self, s: Row) -> dict[str, Any]:
        """Return what a ``RoadScene`` has of the lanes at distances from the curve's beginning [m]."""
        rows = self.curve.curve.interpolate(self.rows, s).astype(np.float32)
        nearest = np.clip(np.round(s / FINE).astype(int), 0, self.open.shape[1] - 1)
        return {"lanes": rows[:LANES], "edges": rows[LANES:], "open": self.open[:, nearest]}


@kept
def corridor(chain: Chain, goal: Goal, block: float) -> Corridor:
    """Return what is around the route along a chain of lanes near a block of it."""
    curve = chain.curve(block, DRIVEN)
    ways = curve.ways
    rows, is_open, low = np.zeros((LANES + 2, ways.size)), np.zeros((LANES, ways.size), dtype=bool), 0
    lanes, edges = rows[:LANES], rows[LANES:]
    for until, section in _sections(chain, goal, ways[-1]):
        here = slice(low, int(np.searchsorted(ways, until)))
        if here.stop <= here.start:
            continue
        low = here.stop
        reference = section[1] or chain.lanes[-1]
        width = float(reference.shape.width_at(0.0))
        lanes[:, here] = np.array([[-width], [0.0], [width]])
        found = []
        for place, lane in enumerate(section):
            if lane:
                beside = lanes[place, here] = _beside(curve.curve, here, lane) if place != 1 else lanes[place, here]
                inside = is_open[place, here] = ~(np.abs(beside) >= NEARBY * width)
                found.append(np.where(inside, beside, 0.0))
        for lane, step in ((section[0], -1), (section[2], 1)):
            outermost = lane and _outermost(lane, step)
            if outermost and outermost is not lane:
                found.append(_beside(curve.curve, here, outermost))
        found = found or [lanes[1, here]]
        edges[:, here] = np.min(found, axis=0) - width / 2, np.max(found, axis=0) + width / 2
    return Corridor(curve, _filled(rows), is_open)


def _sections(chain: Chain, goal: Goal, until: float) -> Iterator[tuple[float, tuple[Lane | None, ...]]]:
    """Yield the sections of a route: the way until which, and the lanes left of it, its own, right of it.

    None stands for a lane that is not there to be driven on. A lane beside the route goes on as that lane does, also
    where it alone leads to the goal; another one begins where the route's road has a lane there that is not forbidden.
    A lane of the route that ends while others beside it go on cannot be driven on from there, one at the end of the
    network can.
    """
    sides: list[Lane | None] = [None, None]
    for own, end in zip(chain.lanes, chain.starts[1:], strict=True):
        for side, step in enumerate((-1, 1)):
            onward, sibling = goal.next(sides[side]), own.beside(step)
            joins = onward and (onward in own.siblings or onward.end == goal.towards.get(own.start))
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


def _filled(rows: Rows) -> Rows:
    """Interpolate where numbers are missing; without any, return zeros."""
    places, known = np.arange(rows.shape[1]), np.isfinite(rows)
    filled = [
        np.interp(places, places[there], row[there]) if there.any() else 0 * places
        for row, there in zip(rows, known, strict=True)
    ]
    return np.stack(filled)


def _outermost(lane: Lane, step: int) -> Lane:
    """Return the last lane towards a side that is reached over lanes that are not forbidden."""
    other = lane.beside(step)
    return lane if other is None or other.forbidden else _outermost(other, step)


def _beside(curve: Curve, here: slice, lane: Lane) -> Row:
    """Return lateral positions of a lane's centre at some of a curve's samples [m], NaN before and after it."""
    x, y, heading = curve.x[here], curve.y[here], curve.heading[here]
    ends = sorted(lane.shape.local_coordinates(np.array([x[end], y[end]]))[0] for end in (0, -1))
    low, high = max(ends[0] - LANE_MARGIN, 0.0), min(ends[1] + LANE_MARGIN, lane.length)
    margin = COARSE if lane.length < 2 * COARSE else 0.0  # for two samples at least
    whole = -margin, lane.length + margin
    _, centres, along = samples(lane.shape, *((low, high) if high - low > LANE_MARGIN else whole))
    along = np.unwrap(along)
    shape = Curve(centres[:, 0], centres[:, 1], along, np.gradient(along, COARSE), 0.0, COARSE)
    s, d, turned = shape.project(x, y, heading)
    outside = np.maximum(-s, s - shape.end)
    return np.where(outside < LANE_EXTENSION, -d / np.maximum(np.cos(turned), MIN_LANE_COSINE), np.nan)
