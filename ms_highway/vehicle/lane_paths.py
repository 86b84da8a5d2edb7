"""Join highway-env's lanes to smooth curves, sampled evenly.

Lanes need not meet where one follows the other, and their curvature jumps there; curves bridge and smooth the joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from highway_env.road.lane import AbstractLane, StraightLane
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline
from scipy.ndimage import gaussian_filter1d

from ms_highway.game.road import BEHIND, SPACING, Path, wrapped

__all__ = ["FINE", "Curve", "join_lanes", "samples", "starts_of"]

FINE = 0.5
"""Distance between samples of curves [m]."""

COARSE = 2.0  # m, between samples of lanes
TRIM = 2.0  # m, left out of lanes on both sides of a joint
MARGIN = 20.0  # m, beyond a curve's ends, for smoothing
SMOOTHING = (1.5, 2.0, 3.0, 4.0, 6.0)  # m, tried in order until no curve is too sharp
SHARPEST = 0.19  # 1/m


@dataclass(frozen=True)
class Curve:
    """A smooth curve along lanes.

    Attributes:
        samples: x, y, heading (unwrapped), curvature and way of points `FINE` apart. The way is the sum of the
            lengths of the lanes passed and the longitudinal coordinate on the present one [m].
    """

    samples: Float[np.ndarray, "5 samples"]

    def gather(
        self, rows: Float[np.ndarray, "rows samples"], s: Float[np.ndarray, "knots"]
    ) -> Float[np.ndarray, "rows knots"]:
        """Interpolate rows that belong to the curve's samples at distances from its beginning [m]."""
        place = np.clip(s / FINE, 0.0, rows.shape[1] - 1.001)
        low = place.astype(int)
        share = place - low
        return rows[:, low] * (1 - share) + rows[:, low + 1] * share

    def path(self, s: float, knots: int) -> Path:
        """Return the path whose s = 0 is at a distance from the curve's beginning [m]; its heading there is wrapped."""
        along = s - BEHIND + SPACING * np.arange(knots)
        x, y, heading, curvature = self.gather(self.samples[:4], along)
        here = heading[int(BEHIND / SPACING)]
        return Path(*np.stack([x, y, heading + wrapped(here) - here, curvature]).astype(np.float32))

    def project(
        self, position: Float[np.ndarray, "2"], heading: float, way: float, reach: float = 20.0
    ) -> tuple[float, float, float]:
        """Return distance from the curve's beginning, distance to its right and heading relative to it.

        Args:
            position: of a car [m].
            heading: of it [rad].
            way: near which it is [m].
            reach: how near [m].
        """
        ways = self.samples[4]
        low = min(int(np.searchsorted(ways, way - reach)), ways.size - 2)
        high = max(int(np.searchsorted(ways, way + reach)), low + 1)
        delta = position[:, None] - self.samples[:2, low:high]
        nearest = int(np.argmin((delta**2).sum(axis=0)))
        _, _, along, bend, _ = self.samples[:, low + nearest]
        x, y = delta[:, nearest]
        cosine, sine = np.cos(along), np.sin(along)
        ahead, aside = cosine * x + sine * y, cosine * y - sine * x
        step = ahead / max(1 - bend * aside, 0.2)
        s = (low + nearest) * FINE + step
        d = aside - bend * ahead * step / 2
        return float(s), float(d), float(wrapped(heading - along - bend * step))

    def way(self, s: float) -> float:
        """Return the way at a distance from the curve's beginning [m]."""
        return float(np.interp(s, FINE * np.arange(self.samples.shape[1]), self.samples[4]))


def starts_of(lanes: Sequence[AbstractLane]) -> list[float]:
    """Return the ways at which each of the lanes begins, and that at which the last one ends [m]."""
    return [0.0, *accumulate(float(lane.length) for lane in lanes)]


def samples(
    lane: AbstractLane, low: float, high: float
) -> tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "samples 2"], Float[np.ndarray, "samples"]]:
    """Return places, positions and headings along a lane, always at the same places between two bounds."""
    s = COARSE * np.arange(np.ceil(low / COARSE), np.floor(high / COARSE) + 1)
    if isinstance(lane, StraightLane):  # the only ones that take arrays
        return s, lane.position(s[:, None], 0.0), np.broadcast_to(lane.heading_at(s), s.shape)
    points = np.array([lane.position(place, 0.0) for place in s]).reshape(-1, 2)
    return s, points, np.array([lane.heading_at(place) for place in s])


def join_lanes(lanes: Sequence[AbstractLane], low: float, high: float) -> Curve:
    """Return the curve along lanes, between two ways; it goes straight on beyond the last one.

    A Hermite spline through positions and headings on the lanes bridges the joints. Averages along it, weighted as by a
    Gaussian and corrected so that they keep circles, make its curvature continuous.
    """
    low, high = low - MARGIN, high + MARGIN
    starts = starts_of(lanes)
    ways, points, headings = [], [], []
    for number, (lane, start) in enumerate(zip(lanes, starts, strict=False)):
        first = TRIM if number else -np.inf
        last = lane.length - (TRIM if number + 1 < len(lanes) else 1.0)
        s, place, heading = samples(lane, max(first, low - start), min(last, high - start))
        ways.append(start + s)
        points.append(place)
        headings.append(heading)
    if high > starts[-1]:
        beyond = np.arange(max(0.0, low - starts[-1]), high - starts[-1] + COARSE, COARSE)
        heading = lanes[-1].heading_at(lanes[-1].length)
        ways.append(starts[-1] + beyond)
        points.append(
            lanes[-1].position(lanes[-1].length, 0.0) + beyond[:, None] * np.array([np.cos(heading), np.sin(heading)])
        )
        headings.append(np.full(beyond.shape, heading))
    raw = _even(np.concatenate(points), np.concatenate(headings), np.concatenate(ways))
    for width in SMOOTHING:
        curve = _smooth(raw, width)
        if np.abs(curve[3]).max() <= SHARPEST:
            break
    return Curve(curve)


def _even(
    points: Float[np.ndarray, "points 2"], headings: Float[np.ndarray, "points"], ways: Float[np.ndarray, "points"]
) -> Float[np.ndarray, "3 samples"]:
    """Return x, y and way of points every `FINE` metres of a Hermite spline."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    spline = CubicHermiteSpline(along, points, np.stack([np.cos(headings), np.sin(headings)], axis=-1))
    dense = np.arange(0.0, along[-1], FINE)
    return _resampled(np.concatenate([spline(dense).T, np.interp(dense, along, ways)[None]]))


def _resampled(rows: Float[np.ndarray, "rows points"]) -> Float[np.ndarray, "rows samples"]:
    """Resample rows, the first two of which are positions, at equal distances."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:2])))])
    even = np.arange(0.0, along[-1], FINE)
    return np.stack([np.interp(even, along, row) for row in rows])


def _smooth(raw: Float[np.ndarray, "3 points"], width: float) -> Float[np.ndarray, "5 samples"]:
    """Return a curve's samples, smoothed over a width [m], without the margins at both ends."""
    once = gaussian_filter1d(raw[:2], width / FINE, mode="nearest")
    twice = gaussian_filter1d(once, width / FINE, mode="nearest")
    cut = int(0.9 * MARGIN / FINE)
    x, y, way = _resampled(np.concatenate([2 * once - twice, raw[2:]])[:, cut:-cut])
    heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    return np.stack([x, y, heading, np.gradient(heading, FINE), way])
