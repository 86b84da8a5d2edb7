"""Coordinates along a curved road, in which the road is straight."""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline, make_smoothing_spline

from ms_highway.irl.arrays import Points, Values

SPACING = 5.0  # m, between the points that the curve is fitted to
STIFFNESS = 2000.0  # m^3; smooths what is shorter than 60 m, (2 pi / 60 m)^4 = 1 / (SPACING STIFFNESS)
FEWEST_POINTS = 5  # that a smoothing spline can be fitted to
ITERATIONS = 6  # each reduces the error to |offset / radius| of it, a few percent on a highway


class LanePosition(NamedTuple):
    """Positions of points on a road, arrays [points].

    Attributes:
        x: along the road [m].
        y: to the right of the reference line [m].
        heading: of the road at the point [rad], counterclockwise, in the coordinates of the map.
    """

    x: Values
    y: Values
    heading: Values


class LaneCoordinates(NamedTuple):
    """A smooth reference line, straight beyond its ends.

    Attributes:
        curve: from the distance along the line [m] to a point (x, y) of the map, whose y points to the left of its x.
        length: of the line [m].
    """

    curve: BSpline
    length: float

    def locate(self, points: Points) -> LanePosition:
        """Return the positions on the road of points of the map."""
        samples = np.linspace(0, self.length, max(int(self.length / SPACING), 2))
        distance = np.linalg.norm(points[:, None] - self.curve(samples), axis=-1)
        x = samples[distance.argmin(axis=1)]
        for _ in range(ITERATIONS):
            nearest_end = np.clip(x, 0, self.length)
            tangent = self.curve(nearest_end, 1)
            tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
            offset = points - self.curve(nearest_end) - (x - nearest_end)[:, None] * tangent
            x = x + (offset * tangent).sum(axis=-1)
        right = offset[:, 0] * tangent[:, 1] - offset[:, 1] * tangent[:, 0]
        return LanePosition(x, right, np.arctan2(tangent[:, 1], tangent[:, 0]))


def fit_lane_coordinates(line: Points) -> LaneCoordinates:
    """Fit coordinates to a line, smoothed: lines of maps have kinks that would look like steering."""
    line = line[np.r_[True, np.any(np.diff(line, axis=0) != 0, axis=-1)]]
    distance = np.r_[0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))]
    even = np.linspace(0, distance[-1], max(round(distance[-1] / SPACING) + 1, FEWEST_POINTS))
    points = np.stack([np.interp(even, distance, coordinate) for coordinate in line.T], axis=-1)
    return LaneCoordinates(make_smoothing_spline(even, points, lam=STIFFNESS), float(distance[-1]))
