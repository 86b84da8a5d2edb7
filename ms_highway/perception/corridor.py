"""Measure the lanes beside a route and the edges of the road."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import NamedTuple, TypedDict

import numpy as np
from jaxtyping import Bool

from ms_highway.geometry.curve import Curve, Knots, Rows
from ms_highway.geometry.lane_paths import LANE_PATHS, LaneCurve, Row, samples
from ms_highway.geometry.road_map import Chain, Goal, Lane, cached_on_owner
from ms_highway.perception.scene import SHAPE


@dataclass(frozen=True)
class RouteSettings:
    """Set how a route is smoothed, and how lanes beside it are measured."""

    smoothing: tuple[float, ...] = (6.0, 4.0, 3.0, 2.0)
    """Widths to try for smoothing a route, which cuts corners, in this order [m]."""
    corner_cut: float = 0.1
    """Distance from the lanes beyond which a route is smoothed less, as in sharp bends
    [m].
    """
    lane_margin: float = 6.0
    """Distance by which lanes are sampled beyond the route beside them [m]."""
    lane_extension: float = 3.0
    """Distance up to which a lane is extended straight on [m]."""
    least_cosine: float = 0.7
    """Lower bound of the cosine of the angle between a lane and the route."""
    nearby: float = 2.0
    """Distance within which the robot can change to a lane that diverges [widths of a
    lane].
    """


ROUTE = RouteSettings()


class LaneFields(TypedDict):
    """The fields of a ``RoadScene`` that describe lanes."""

    lanes: Knots
    edges: Knots
    open: Knots


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

    def at(self, s: Row) -> LaneFields:
        """Return the fields of a ``RoadScene`` that describe lanes.

        Args:
            s: distances from the beginning of the curve [m].
        """
        interpolated = self.curve.curve.interpolate(self.rows, s)
        rows = interpolated.astype(np.float32)

        # Whether a lane is open is not interpolated: the nearest sample counts.
        samples_of_s = np.round(s / LANE_PATHS.spacing).astype(int)
        last_sample = self.open.shape[1] - 1
        nearest = np.clip(samples_of_s, 0, last_sample)
        return {
            "lanes": rows[: SHAPE.lanes],
            "edges": rows[SHAPE.lanes :],
            "open": self.open[:, nearest],
        }


class Section(NamedTuple):
    """A stretch of a route on which the lanes do not change.

    Attributes:
        end: way along the route at the end of the stretch [m].
        left: lane to the left; None if it is closed.
        own: lane of the route; None if it is closed.
        right: lane to the right; None if it is closed.
    """

    end: float
    left: Lane | None
    own: Lane | None
    right: Lane | None


@cached_on_owner
def corridor(chain: Chain, goal: Goal, block: float) -> Corridor:
    """Return the corridor of the route along a chain of lanes near a block of it."""
    curve = chain.curve(block, ROUTE.smoothing, ROUTE.corner_cut)
    ways = curve.ways  # along the chain, at each sample of the curve
    rows = np.zeros((SHAPE.lanes + 2, ways.size))
    is_open = np.zeros((SHAPE.lanes, ways.size), dtype=bool)

    # Measure section by section; short ones may have no samples.
    begin = 0
    for section in _sections(chain, goal, ways[-1]):
        end = int(np.searchsorted(ways, section.end))
        if end <= begin:
            continue
        here = slice(begin, end)
        width_lane = section.own or chain.lanes[-1]
        width = float(width_lane.shape.width_at(0.0))
        section_rows, section_open = _measure(curve.curve, here, section, width)
        rows[:, here] = section_rows
        is_open[:, here] = section_open
        begin = end
    _fill(rows)
    return Corridor(curve, rows, is_open)


def _measure(
    curve: Curve,
    here: slice,
    section: Section,
    width: float,
) -> tuple[Rows, Bool[np.ndarray, "lanes samples"]]:
    """Measure the lanes and the edges of the road in a section of a route.

    Args:
        curve: of the route.
        here: its samples in this section.
        section: of the route.
        width: of its lanes [m].

    Returns:
        Lateral positions of lanes and edges [m], and where the lanes are open.
    """
    # Closed lanes are beside the route; nothing else is known of them.
    count = here.stop - here.start
    lanes = np.repeat([[-width], [0.0], [width]], count, axis=1)
    is_open = np.zeros((SHAPE.lanes, count), dtype=bool)
    own = SHAPE.own_lane
    is_open[own] = section.own is not None

    # Lanes that diverge from the route are closed where they are far away.
    centres = []
    if section.own:
        centres.append(lanes[own])
    for lane, step in ((section.left, -1), (section.right, 1)):
        if lane is None:
            continue
        beside = _beside(curve, here, lane)
        is_far = np.abs(beside) >= ROUTE.nearby * width  # False where NaN
        is_near = ~is_far
        lanes[own + step] = beside
        is_open[own + step] = is_near
        centres.append(np.where(is_near, beside, 0.0))
        outermost = _outermost(lane, step)
        if outermost is not lane:
            centres.append(_beside(curve, here, outermost))

    # The road reaches from the outermost lane on the left to that on the right.
    centres = centres or [lanes[own]]
    left_edge = np.min(centres, axis=0) - width / 2
    right_edge = np.max(centres, axis=0) + width / 2
    return np.concatenate([lanes, [left_edge, right_edge]]), is_open


def _sections(chain: Chain, goal: Goal, until: float) -> Iterator[Section]:
    """Yield the sections of a route up to a way along it.

    A lane beside the route continues as long as it is on the route's roads or leads to
    the goal; otherwise the neighbour of the route's next lane follows, unless it is
    forbidden. Where the route's last lane ends but its neighbours continue, the route's
    own lane is closed from there on; at the end of the network, it stays open.
    """
    sides: list[Lane | None] = [None, None]
    for own, end in zip(chain.lanes, chain.starts[1:], strict=True):
        for side, step in enumerate((-1, 1)):
            continuation = goal.next(sides[side])
            if not _continues(continuation, own, chain, goal):
                continuation = own.beside(step)
                if continuation is not None and continuation.forbidden:
                    continuation = None
            sides[side] = continuation
        yield Section(end, sides[0], own, sides[1])

    # Beyond the end of the route's lanes.
    last = None if chain.lanes[-1].refuge else chain.lanes[-1]
    way = chain.starts[-1]
    while way < until:
        continuations = [goal.next(side) for side in sides]
        if last is None:
            sides = continuations
        lengths = [lane.length for lane in continuations if lane]
        way += min(lengths, default=inf)
        yield Section(way, sides[0], last, sides[1])


def _continues(beside: Lane | None, own: Lane, chain: Chain, goal: Goal) -> bool:
    """Return whether a lane goes on beside the route's own lane.

    It does if it is on the same road, or leads to the goal, and if the route itself
    does not follow it.
    """
    if beside is None or beside in chain.lanes:
        return False
    return beside in own.siblings or beside.end == goal.towards.get(own.start)


def _fill(rows: Rows) -> None:
    """Replace NaN in rows by interpolation, or by 0 in rows of NaN only."""
    for row in rows:
        is_known = np.isfinite(row)
        if not is_known.any():
            row[:] = 0.0
            continue
        known = np.flatnonzero(is_known)
        unknown = np.flatnonzero(~is_known)
        row[unknown] = np.interp(unknown, known, row[known])


def _outermost(lane: Lane, step: int) -> Lane:
    """Return the last lane to the left, -1, or right, 1, before a forbidden one."""
    other = lane.beside(step)
    if other is None or other.forbidden:
        return lane
    return _outermost(other, step)


def _beside(curve: Curve, here: slice, lane: Lane) -> Row:
    """Return lateral positions of a lane's centre at some of a curve's samples [m].

    They are NaN beyond the ends of the lane.
    """
    x = curve.x[here]
    y = curve.y[here]
    heading = curve.heading[here]
    spacing = LANE_PATHS.lane_spacing

    # The part of the lane beside these samples ...
    first, _ = lane.shape.local_coordinates(np.array([x[0], y[0]]))
    last, _ = lane.shape.local_coordinates(np.array([x[-1], y[-1]]))
    nearest = min(first, last)
    farthest = max(first, last)
    low = max(nearest - ROUTE.lane_margin, 0.0)
    high = min(farthest + ROUTE.lane_margin, lane.length)

    # ... or the whole lane if this part is short. A curve needs two samples.
    if high - low <= ROUTE.lane_margin:
        margin = spacing if lane.length < 2 * spacing else 0.0
        low = -margin
        high = lane.length + margin
    _, centres, along = samples(lane.shape, low, high)

    # The samples in the coordinates of this part.
    along = np.unwrap(along)
    bend = np.gradient(along, spacing)
    part = Curve(centres[:, 0], centres[:, 1], along, bend, 0.0, spacing)
    s, d, turned = part.project(x, y, heading)
    beyond_end = np.maximum(-s, s - part.end)
    cosine = np.maximum(np.cos(turned), ROUTE.least_cosine)
    beside = -d / cosine
    return np.where(beyond_end < ROUTE.lane_extension, beside, np.nan)
