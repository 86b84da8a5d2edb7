"""Measure the lanes beside a route: their positions, where they are open, and the edges of the road."""

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

LANE_MARGIN = 6.0  # m, by which lanes are sampled beyond the route beside them
MIN_LANE_COSINE = 0.7  # lower bound of the cosine of the angle between a lane and the route
LANE_EXTENSION = 3.0  # m, up to which a lane is extended straight on
DRIVEN = (6.0,)  # m, smoothing width of routes, which cut the corners of joints by up to 0.6 m
NEARBY = 2.0  # widths of a lane within which the robot can change to a lane that diverges


@dataclass(frozen=True)
class Corridor:
    """A route's curve and, at its samples, the road around it.

    Attributes:
        curve: of the route.
        rows: lateral positions of the lanes left of it, on it, right of it, and of the road's edges [m].
        open: where the robot may drive on the lanes.
    """

    curve: LaneCurve
    rows: Rows
    open: Bool[np.ndarray, "lanes samples"]

    def at(self, s: Row) -> dict[str, Any]:
        """Return the fields of a ``RoadScene`` that describe lanes, at distances from the curve's beginning [m]."""
        rows = self.curve.curve.interpolate(self.rows, s).astype(np.float32)
        nearest = np.clip(np.round(s / FINE).astype(int), 0, self.open.shape[1] - 1)
        return {"lanes": rows[:LANES], "edges": rows[LANES:], "open": self.open[:, nearest]}


@kept
def corridor(chain: Chain, goal: Goal, block: float) -> Corridor:
    """Return the corridor of the route along a chain of lanes near a block of it."""
    curve = chain.curve(block, DRIVEN)
    ways = curve.ways
    rows, is_open, low = np.zeros((LANES + 2, ways.size)), np.zeros((LANES, ways.size), dtype=bool), 0
    lanes, edges = rows[:LANES], rows[LANES:]
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
        edges[:, here] = np.min(centres, axis=0) - width / 2, np.max(centres, axis=0) + width / 2
    _fill(rows)
    return Corridor(curve, rows, is_open)


def _sections(chain: Chain, goal: Goal, until: float) -> Iterator[tuple[float, tuple[Lane | None, ...]]]:
    """Yield the sections of a route: the way at their end, and the lane left of the route, its own, and right of it.

    None stands for a closed lane. A lane beside the route continues as long as it is on the route's roads or leads to
    the goal; otherwise the neighbour of the route's next lane follows, unless it is forbidden. Where the route's last
    lane ends but its neighbours continue, the route's own lane is closed from there on; at the end of the network, it
    stays open.
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


def _fill(rows: Rows) -> None:
    """Replace NaN in rows by interpolation, or by 0 in rows of NaN only."""
    for row in rows:
        known = np.isfinite(row)
        filled = np.interp(np.flatnonzero(~known), np.flatnonzero(known), row[known]) if known.any() else 0.0
        row[~known] = filled


def _outermost(lane: Lane, step: int) -> Lane:
    """Return the last lane to the left (step -1) or to the right (1) before a forbidden one."""
    other = lane.beside(step)
    return lane if other is None or other.forbidden else _outermost(other, step)


def _beside(curve: Curve, here: slice, lane: Lane) -> Row:
    """Return lateral positions of a lane's centre at some of a curve's samples [m], NaN beyond the lane's ends."""
    x, y, heading = curve.x[here], curve.y[here], curve.heading[here]
    ends = sorted(lane.shape.local_coordinates(np.array([x[end], y[end]]))[0] for end in (0, -1))
    low, high = max(ends[0] - LANE_MARGIN, 0.0), min(ends[1] + LANE_MARGIN, lane.length)
    margin = COARSE if lane.length < 2 * COARSE else 0.0  # so that there are two samples
    whole = -margin, lane.length + margin
    _, centres, along = samples(lane.shape, *((low, high) if high - low > LANE_MARGIN else whole))
    along = np.unwrap(along)
    shape = Curve(centres[:, 0], centres[:, 1], along, np.gradient(along, COARSE), 0.0, COARSE)
    s, d, turned = shape.project(x, y, heading)
    outside = np.maximum(-s, s - shape.end)
    return np.where(outside < LANE_EXTENSION, -d / np.maximum(np.cos(turned), MIN_LANE_COSINE), np.nan)
