"""Join highway-env's lanes to smooth curves with evenly spaced samples.

Lanes may have gaps and jumps of curvature where one continues the other; curves bridge
gaps and smooth joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from highway_env.road.lane import AbstractLane
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d

from ms_highway.geometry.curve import (
    BEHIND,
    SPACING,
    Curve,
    Rows,
    arc_lengths,
    resample,
    wrapped,
)

Point = Float[np.ndarray, "2"]
Row = Float[np.ndarray, "samples"]
Points = Float[np.ndarray, "samples 2"]


@dataclass(frozen=True)
class LanePathSettings:
    """Set how lanes are sampled, and joined to smooth curves."""

    spacing: float = 0.5
    """Distance between samples of curves [m]."""
    lane_spacing: float = 2.0
    """Distance between samples of lanes [m]; a spline joins these."""
    trim: float = 2.0
    """Length omitted from lanes on both sides of a joint [m], which the spline bridges.
    """
    end_trim: float = 1.0
    """Length omitted at the end of the last lane [m]."""
    margin: float = 20.0
    """Length beyond a curve's ends, for smoothing [m]."""
    cut: float = 0.9
    """Share of the margin that is cut off after smoothing, as its ends are not smooth.
    """
    widths: tuple[float, ...] = (1.5, 2.0, 3.0, 4.0, 6.0)
    """Widths of the Gaussian, tried in this order [m]."""
    max_curvature: float = 0.19
    """Largest curvature at which no wider Gaussian is tried [1/m]."""
    sharper: float = 1.05
    """Ratio of largest curvatures from which a curve counts as sharper."""
    search: float = 20.0
    """Distance along a curve within which a car is searched for [m]."""


LANE_PATHS = LanePathSettings()


@dataclass(frozen=True)
class LaneCurve:
    """A smooth curve along lanes.

    Attributes:
        curve: sampled from s = 0 on at the ``spacing`` of `LanePathSettings`.
        ways: of the samples: the length of all lanes before, plus the longitudinal
            coordinate on the lane [m].
    """

    curve: Curve
    ways: Row

    @cached_property
    def rows(self) -> Rows:
        """x, y, heading and curvature of the samples, [4, samples]."""
        curve = self.curve
        return np.stack([curve.x, curve.y, curve.heading, curve.curvature])

    def way(self, s: float) -> float:
        """Return the way at a distance from the curve's beginning [m]."""
        along = LANE_PATHS.spacing * np.arange(self.ways.size)
        return float(np.interp(s, along, self.ways))


def project_cars(
    curves: Sequence[LaneCurve],
    positions: Points,
    headings: Row,
    ways: Row,
) -> tuple[Row, Row, Row]:
    """Return s, d and the relative heading of cars, each on its own curve.

    Args:
        curves: one for each car.
        positions: of the cars [m].
        headings: of the cars [rad].
        ways: approximate ways of the cars [m], since lanes may cross themselves.
    """
    # The part of each curve near its car, all parts of the same length.
    spacing = LANE_PATHS.spacing
    length = int(2 * LANE_PATHS.search / spacing) + 1  # samples of a part
    firsts = np.zeros(len(curves), dtype=int)
    parts = np.zeros((4, len(curves), length))
    for car, (curve, way) in enumerate(zip(curves, ways, strict=True)):
        low = int(np.searchsorted(curve.ways, way - LANE_PATHS.search))
        first = min(low, curve.ways.size - length)
        firsts[car] = first
        parts[:, car] = curve.rows[:, first : first + length]

    # Project each car on its own part [cars, 1].
    part_x, part_y, part_heading, part_curvature = parts
    starts = spacing * firsts[:, None]
    near = Curve(part_x, part_y, part_heading, part_curvature, starts, spacing)
    x, y = positions.T[:, :, None]
    s, d, turned = near.project(x, y, headings[:, None])
    return np.asarray(s[:, 0]), np.asarray(d[:, 0]), np.asarray(turned[:, 0])


def paths_from(curves: Sequence[LaneCurve], s: Row, knots: int) -> Curve:
    """Return a part of each curve, with s = 0 where the curve has the given s.

    Arrays are [curves, knots], of single precision. Headings at s = 0 are wrapped.
    Beyond the ends of a curve, its outermost sample is repeated.

    Args:
        curves: along lanes.
        s: distance from the beginning of each curve [m].
        knots: number of samples of each path, every `SPACING` metres from `BEHIND`
            metres behind on.
    """
    # The samples of the curves before and after each knot, and the share of the way
    # between them.
    spacing = LANE_PATHS.spacing
    places = s[:, None] - BEHIND + SPACING * np.arange(knots)  # [curves, knots]
    indices = np.floor(places / spacing).astype(int)
    share = places / spacing - indices
    rows_before = []
    rows_after = []
    for curve, index in zip(curves, indices, strict=True):
        rows_before.append(curve.rows.take(index, axis=1, mode="clip"))  # [4, knots]
        rows_after.append(curve.rows.take(index + 1, axis=1, mode="clip"))

    # Interpolate between them [4, curves, knots].
    before = np.stack(rows_before, axis=1)
    after = np.stack(rows_after, axis=1)
    x, y, heading, curvature = before * (1 - share) + after * share

    # Wrap the headings at s = 0.
    heading_now = heading[:, int(BEHIND / SPACING), None]
    heading = heading + wrapped(heading_now) - heading_now
    rows = np.stack([x, y, heading, curvature])
    return Curve(*rows.astype(np.float32))


def samples(lane: AbstractLane, low: float, high: float) -> tuple[Row, Points, Row]:
    """Return places, positions and headings along a lane between two bounds."""
    spacing = LANE_PATHS.lane_spacing
    first = np.ceil(low / spacing)
    last = np.floor(high / spacing)
    s = spacing * np.arange(first, last + 1)
    points = np.array([lane.position(place, 0.0) for place in s])
    headings = np.array([lane.heading_at(place) for place in s])
    return s, points.reshape(-1, 2), headings


def join_lanes(
    lanes: Sequence[AbstractLane],
    starts: Sequence[float],
    low: float,
    high: float,
    widths: Sequence[float],
    within: float = np.inf,
) -> LaneCurve:
    """Return the curve along lanes between two ways.

    It goes straight on beyond the last lane. A Hermite spline through positions and
    headings on the lanes bridges the joints. A Gaussian filter, corrected so that it
    keeps circles, makes its curvature continuous.

    Args:
        lanes: that continue each other.
        starts: ways at which the lanes begin, and at which the last one ends [m].
        low: way from which on the curve is needed [m].
        high: way until which the curve is needed [m].
        widths: of the Gaussian [m], tried in order until no curvature exceeds the
            ``max_curvature`` of `LanePathSettings` and the curve is near the lanes.
        within: distance from the lanes that counts as near [m]. No width is tried by
            which the curve becomes sharper than before and than the lanes are: it would
            follow a kink at a joint.
    """
    margin = LANE_PATHS.margin
    parts = _sampled(lanes, starts, low - margin, high + margin)
    ways, points, headings = map(np.concatenate, zip(*parts, strict=True))
    raw = _bridged(ways, points, headings)

    # Bends of the lanes themselves are to be followed, kinks at joints to be smoothed.
    sharpest = 0.0
    for _, _, headings_of_lane in parts:
        turns = np.abs(wrapped(np.diff(headings_of_lane)))
        sharpest = max(sharpest, turns.max(initial=0.0) / LANE_PATHS.lane_spacing)

    # Try wider and wider Gaussians.
    found = None
    for width in widths:
        smooth, moved = _smooth(raw, width)
        bend = np.abs(smooth.curve.curvature).max()
        is_sharper = within < np.inf and bend > LANE_PATHS.sharper * sharpest
        if found and is_sharper:
            break
        found = smooth
        sharpest = max(sharpest, bend)
        if bend <= LANE_PATHS.max_curvature and moved <= within:
            break
    assert found
    return found


def _sampled(
    lanes: Sequence[AbstractLane],
    starts: Sequence[float],
    low: float,
    high: float,
) -> list[tuple[Row, Points, Row]]:
    """Return ways, positions and headings along each lane between two ways.

    The last part is the straight line beyond the last lane, if the second way is there.
    """
    parts = []
    for index, (lane, start) in enumerate(zip(lanes, starts, strict=False)):
        is_last = index + 1 == len(lanes)
        trim_at_end = LANE_PATHS.end_trim if is_last else LANE_PATHS.trim
        first = LANE_PATHS.trim if index else -np.inf
        last = lane.length - trim_at_end
        from_s = max(first, low - start)
        to_s = min(last, high - start)
        s, points, headings = samples(lane, from_s, to_s)
        parts.append((start + s, points, headings))

    end = starts[-1]
    if high > end:
        spacing = LANE_PATHS.lane_spacing
        beyond = np.arange(max(0.0, low - end), high - end + spacing, spacing)
        heading = lane.heading_at(lane.length)
        direction = np.array([np.cos(heading), np.sin(heading)])
        points = lane.position(lane.length, 0.0) + beyond[:, None] * direction
        headings = np.full(beyond.shape, heading)
        parts.append((end + beyond, points, headings))
    return parts


def _bridged(
    ways: Row,
    points: Points,
    headings: Row,
) -> Float[np.ndarray, "rows bridged"]:
    """Return rows of x, y and way, evenly spaced along a Hermite spline."""
    spacing = LANE_PATHS.spacing
    along = arc_lengths(points.T)
    directions = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    spline = CubicHermiteSpline(along, points, directions)
    dense = np.arange(0.0, along[-1], spacing)
    dense_positions = spline(dense).T  # [2, samples]
    dense_ways = np.interp(dense, along, ways)
    rows = np.concatenate([dense_positions, dense_ways[None]])
    return resample(rows, spacing)


def _smooth(raw: Rows, width: float) -> tuple[LaneCurve, float]:
    """Return a smoothed curve, and its distance from the lanes [m].

    The margins at both ends are cut off.

    Args:
        raw: rows of x, y and way.
        width: of the Gaussian [m].
    """
    spacing = LANE_PATHS.spacing
    width_in_samples = width / spacing
    once = gaussian_filter1d(raw[:2], width_in_samples, mode="nearest")
    twice = gaussian_filter1d(once, width_in_samples, mode="nearest")

    # Smoothing moves a bend towards its inside, twice as far the second time.
    smooth = 2 * once - twice
    cut = int(LANE_PATHS.cut * LANE_PATHS.margin / spacing)
    dx, dy = (smooth - raw[:2])[:, cut:-cut]
    moved = np.hypot(dx, dy).max()

    # Sample evenly what the cut leaves.
    rows = np.concatenate([smooth, raw[2:]])
    x, y, ways = resample(rows[:, cut:-cut], spacing)
    curve = Curve.through(x, y, spacing)
    return LaneCurve(curve, ways), float(moved)
