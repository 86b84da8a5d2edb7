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

FINE = 0.5
"""Distance between samples of curves [m]."""

COARSE = 2.0  # m, between samples of lanes
TRIM = 2.0  # m, omitted from lanes on both sides of a joint
MARGIN = 20.0  # m, beyond a curve's ends, for smoothing
SMOOTHING = (1.5, 2.0, 3.0, 4.0, 6.0)  # m, widths of the Gaussian
MAX_CURVATURE = 0.19  # 1/m
SHARPER = 1.05  # ratio of the largest curvatures from which a curve counts as sharper
NEAR = 20.0  # m along a curve within which a car is searched for


@dataclass(frozen=True)
class LaneCurve:
    """A smooth curve along lanes.

    Attributes:
        curve: sampled every `FINE` metres, from s = 0 on.
        ways: of the samples: the length of all lanes before, plus the longitudinal
            coordinate on the lane [m].
    """

    curve: Curve
    ways: Row

    @cached_property
    def rows(self) -> Rows:
        """x, y, heading and curvature of the samples, [4, samples]."""
        own = self.curve
        return np.stack([own.x, own.y, own.heading, own.curvature])

    def way(self, s: float) -> float:
        """Return the way at a distance from the curve's beginning [m]."""
        return float(np.interp(s, FINE * np.arange(self.ways.size), self.ways))


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
    number = int(2 * NEAR / FINE) + 1
    first = np.zeros(len(curves), dtype=int)
    parts = np.zeros((4, len(curves), number))
    for place, (curve, way) in enumerate(zip(curves, ways, strict=True)):
        low = int(np.searchsorted(curve.ways, way - NEAR))
        first[place] = min(low, curve.ways.size - number)
        parts[:, place] = curve.rows[:, first[place] : first[place] + number]

    # Project each car on its own part.
    x, y = positions.T[:, :, None]
    own_x, own_y, along, bend = parts
    near = Curve(own_x, own_y, along, bend, FINE * first[:, None], FINE)
    s, d, turned = near.project(x, y, headings[:, None])
    return np.asarray(s[:, 0]), np.asarray(d[:, 0]), np.asarray(turned[:, 0])


def paths_from(curves: Sequence[LaneCurve], s: Row, knots: int) -> Curve:
    """Return curves with s = 0 at the given s, arrays [curves, knots] of single
    precision.

    Their headings at s = 0 are wrapped. Beyond the ends of a curve, its outermost
    sample is repeated.

    Args:
        curves: along lanes.
        s: distance from the beginning of each curve [m].
        knots: number of samples of each path, every `SPACING` metres from `BEHIND`
            metres behind on.
    """
    # The samples of the curves before and after each knot, and the share of the way
    # between them.
    places = s[:, None] - BEHIND + SPACING * np.arange(knots)
    before = np.floor(places / FINE).astype(int)
    share = places / FINE - before
    sides = np.stack([before, before + 1], axis=1)
    found = []
    for curve, own in zip(curves, sides, strict=True):
        found.append(curve.rows.take(own, axis=1, mode="clip"))  # [4, 2, knots]
    left, right = np.stack(found, axis=1).swapaxes(0, 2)  # [curves, 4, knots]

    # Interpolate between them.
    share = share[:, None]
    x, y, heading, curvature = (left * (1 - share) + right * share).swapaxes(0, 1)
    here = heading[:, int(BEHIND / SPACING), None]
    heading = heading + wrapped(here) - here
    return Curve(*np.stack([x, y, heading, curvature]).astype(np.float32))


def samples(lane: AbstractLane, low: float, high: float) -> tuple[Row, Points, Row]:
    """Return places, positions and headings along a lane every `COARSE` metres between
    two bounds.
    """
    s = COARSE * np.arange(np.ceil(low / COARSE), np.floor(high / COARSE) + 1)
    points = np.array([lane.position(place, 0.0) for place in s]).reshape(-1, 2)
    return s, points, np.array([lane.heading_at(place) for place in s])


def join_lanes(
    lanes: Sequence[AbstractLane],
    starts: Sequence[float],
    low: float,
    high: float,
    widths: Sequence[float],
    within: float = np.inf,
) -> LaneCurve:
    """Return the curve along lanes between two ways; it goes straight on beyond the
    last lane.

    A Hermite spline through positions and headings on the lanes bridges the joints. A
    Gaussian filter, corrected so that it keeps circles, makes its curvature continuous.

    Args:
        lanes: that continue each other.
        starts: ways at which the lanes begin, and at which the last one ends [m].
        low: way from which on the curve is needed [m].
        high: way until which the curve is needed [m].
        widths: of the Gaussian [m], tried in order until no curvature exceeds
            `MAX_CURVATURE` and the curve is near the lanes.
        within: distance from the lanes that counts as near [m]. No width is tried by
            which the curve becomes sharper than before and than the lanes are: it would
            follow a kink at a joint.
    """
    low = low - MARGIN
    high = high + MARGIN
    end = starts[-1]
    parts = []
    for number, (lane, start) in enumerate(zip(lanes, starts, strict=False)):
        first = TRIM if number else -np.inf
        last = lane.length - (TRIM if number + 1 < len(lanes) else 1.0)
        s, points, headings = samples(
            lane, max(first, low - start), min(last, high - start)
        )
        parts.append((start + s, points, headings))
    if high > end:
        beyond = np.arange(max(0.0, low - end), high - end + COARSE, COARSE)
        heading = lane.heading_at(lane.length)
        straight = beyond[:, None] * np.array([np.cos(heading), np.sin(heading)])
        parts.append(
            (
                end + beyond,
                lane.position(lane.length, 0.0) + straight,
                np.full(beyond.shape, heading),
            )
        )
    raw = _bridged(*map(np.concatenate, zip(*parts, strict=True)))

    # Bends of the lanes themselves are to be followed, kinks at joints to be smoothed.
    sharpest = 0.0
    for _, _, headings in parts:
        turns = np.abs(wrapped(np.diff(headings)))
        sharpest = max(sharpest, turns.max(initial=0.0) / COARSE)
    found = None
    for width in widths:
        smooth, moved = _smooth(raw, width)
        bend = np.abs(smooth.curve.curvature).max()
        if found and within < np.inf and bend > SHARPER * sharpest:
            break
        found = smooth
        sharpest = max(sharpest, bend)
        if bend <= MAX_CURVATURE and moved <= within:
            break
    assert found
    return found


def _bridged(ways: Row, points: Points, headings: Row) -> Rows:
    """Return rows of x, y and way every `FINE` metres along a Hermite spline."""
    along = arc_lengths(points.T)
    spline = CubicHermiteSpline(
        along, points, np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    )
    dense = np.arange(0.0, along[-1], FINE)
    return resample(
        np.concatenate([spline(dense).T, np.interp(dense, along, ways)[None]]), FINE
    )


def _smooth(raw: Rows, width: float) -> tuple[LaneCurve, float]:
    """Return the curve smoothed over a width, without the margins at both ends, and its
    distance from the lanes [m].
    """
    once = gaussian_filter1d(raw[:2], width / FINE, mode="nearest")
    twice = gaussian_filter1d(once, width / FINE, mode="nearest")
    cut = int(0.9 * MARGIN / FINE)
    smooth = 2 * once - twice
    moved = np.hypot(*(smooth - raw[:2])[:, cut:-cut]).max()
    x, y, ways = resample(np.concatenate([smooth, raw[2:]])[:, cut:-cut], FINE)
    return LaneCurve(Curve.through(x, y, FINE), ways), float(moved)
