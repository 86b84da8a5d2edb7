"""Join highway-env's lanes to smooth curves with evenly spaced samples.

Lanes may have gaps and jumps of curvature where one continues the other; curves bridge gaps and smooth joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from highway_env.road.lane import AbstractLane
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d

from ms_highway.geometry.curve import BEHIND, SPACING, Curve, Rows, arc_lengths, resample, wrapped

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
        ways: of the samples: the length of all lanes before, plus the longitudinal coordinate on the lane [m].
    """

    curve: Curve
    ways: Row

    def path(self, s: float, knots: int) -> Curve:
        """Return the curve with s = 0 at a distance from this one's beginning [m]; its heading there is wrapped."""
        own = self.curve
        places = s - BEHIND + SPACING * np.arange(knots)
        x, y, heading, curvature = own.interpolate(np.stack([own.x, own.y, own.heading, own.curvature]), places)
        here = heading[int(BEHIND / SPACING)]
        return Curve(*np.stack([x, y, heading + wrapped(here) - here, curvature]).astype(np.float32))

    def project(self, position: Point, heading: float, way: float) -> tuple[float, float, float]:
        """Return s, d and the heading of a car relative to the curve.

        Args:
            position: of the car [m].
            heading: of the car [rad].
            way: approximate way of the car [m], since lanes may cross themselves.
        """
        low = min(int(np.searchsorted(self.ways, way - NEAR)), self.ways.size - 2)
        high = max(int(np.searchsorted(self.ways, way + NEAR)), low + 2)
        x, y = position
        s, d, turned = self.curve.part(low, high).project(x, y, heading)
        return float(s), float(d), float(turned)

    def way(self, s: float) -> float:
        """Return the way at a distance from the curve's beginning [m]."""
        return float(self.curve.interpolate(self.ways, s))


def samples(lane: AbstractLane, low: float, high: float) -> tuple[Row, Points, Row]:
    """Return places, positions and headings along a lane every `COARSE` metres between two bounds."""
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
    """Return the curve along lanes between two ways; it goes straight on beyond the last lane.

    A Hermite spline through positions and headings on the lanes bridges the joints. A Gaussian filter, corrected so
    that it keeps circles, makes its curvature continuous.

    Args:
        lanes: that continue each other.
        starts: ways at which the lanes begin, and at which the last one ends [m].
        low: way from which on the curve is needed [m].
        high: way until which the curve is needed [m].
        widths: of the Gaussian [m], tried in order until no curvature exceeds `MAX_CURVATURE` and the curve is near the
            lanes.
        within: distance from the lanes that counts as near [m]. No width is tried by which the curve becomes sharper
            than before and than the lanes are: it would follow a kink at a joint.
    """
    low, high, end = low - MARGIN, high + MARGIN, starts[-1]
    parts = []
    for number, (lane, start) in enumerate(zip(lanes, starts, strict=False)):
        first = TRIM if number else -np.inf
        last = lane.length - (TRIM if number + 1 < len(lanes) else 1.0)
        s, points, headings = samples(lane, max(first, low - start), min(last, high - start))
        parts.append((start + s, points, headings))
    if high > end:
        beyond, heading = np.arange(max(0.0, low - end), high - end + COARSE, COARSE), lane.heading_at(lane.length)
        straight = beyond[:, None] * np.array([np.cos(heading), np.sin(heading)])
        parts.append((end + beyond, lane.position(lane.length, 0.0) + straight, np.full(beyond.shape, heading)))
    raw = _bridged(*map(np.concatenate, zip(*parts, strict=True)))

    # Bends of the lanes themselves are to be followed, kinks at joints to be smoothed.
    turns = [np.abs(wrapped(np.diff(headings))) for _, _, headings in parts]
    sharpest = max(turn.max(initial=0.0) for turn in turns) / COARSE
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
    spline = CubicHermiteSpline(along, points, np.stack([np.cos(headings), np.sin(headings)], axis=-1))
    dense = np.arange(0.0, along[-1], FINE)
    return resample(np.concatenate([spline(dense).T, np.interp(dense, along, ways)[None]]), FINE)


def _smooth(raw: Rows, width: float) -> tuple[LaneCurve, float]:
    """Return the curve smoothed over a width, without the margins at both ends, and its distance from the lanes [m]."""
    once = gaussian_filter1d(raw[:2], width / FINE, mode="nearest")
    twice = gaussian_filter1d(once, width / FINE, mode="nearest")
    cut = int(0.9 * MARGIN / FINE)
    smooth = 2 * once - twice
    moved = np.hypot(*(smooth - raw[:2])[:, cut:-cut]).max()
    x, y, ways = resample(np.concatenate([smooth, raw[2:]])[:, cut:-cut], FINE)
    return LaneCurve(Curve.through(x, y, FINE), ways), float(moved)
