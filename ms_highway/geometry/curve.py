"""Curves, and coordinates along and across them, for arrays of NumPy and of JAX.

Curve coordinates are (s, d): s along the curve, d to its right [m]. World coordinates
are highway-env's: y points to the right of x. In coordinates whose y points to the
left, d is to the left.
"""

from dataclasses import dataclass, field, replace
from math import pi
from types import ModuleType
from typing import Any, Literal

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import Numbers, Numeric

SPACING = 2.0
"""Default distance between the samples of a curve [m]."""

BEHIND = 20.0
"""Length of a scene's curve behind the car that follows it [m]; the car is near s = 0.
"""

STEPS = 2  # iterations of a projection, from the nearest sample
# smallest distance of a position from a bend's centre, as a share of the radius
TIGHTEST = 0.2

Knots = Float[Any, "*curves samples"]
Rows = Float[np.ndarray, "rows samples"]
Pose = tuple[Numbers, Numbers, Numbers]
"""x, y and heading in world coordinates, or s, d and heading in those of a curve."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Curve:
    """A curve with evenly spaced samples; it goes straight on beyond its ends.

    Attributes:
        x, y: position of the samples [m].
        heading: of the curve, unwrapped [rad].
        curvature: of the curve, positive to the right [1/m].
        start: s of the first sample [m] (static); in NumPy, several curves may have one
            each, [curves, 1].
        spacing: distance between samples [m] (static).
    """

    x: Knots
    y: Knots
    heading: Knots
    curvature: Knots
    start: Numeric = field(default=-BEHIND, metadata={"static": True})
    spacing: float = field(default=SPACING, metadata={"static": True})

    @classmethod
    def through(cls, x: Knots, y: Knots, spacing: float) -> "Curve":
        """Return the curve from s = 0 through evenly spaced positions; see `resample`."""
        order: Literal[1, 2] = 2 if len(x) > 2 else 1  # two points have one slope
        along = np.gradient(x, edge_order=order)
        aside = np.gradient(y, edge_order=order)
        heading = np.unwrap(np.arctan2(aside, along))
        return cls(x, y, heading, np.gradient(heading, spacing), 0.0, spacing)

    @property
    def end(self) -> Numeric:
        """Return s of the last sample [m]."""
        return self.start + (np.shape(self.x)[-1] - 1) * self.spacing

    def interpolate(self, values: Knots, s: Numeric) -> Numbers:
        """Interpolate values that belong to the samples; beyond the ends, the outermost
        are kept.
        """
        return interpolate(values, s, self.start, self.spacing)

    def place(self, s: Numeric, d: Numeric) -> Pose:
        """Return x, y and the curve's heading at curve coordinates."""
        x, y, heading, _ = self._at(s)
        xp = namespace(heading)
        cosine = xp.cos(heading)
        sine = xp.sin(heading)
        beyond = s - xp.minimum(xp.maximum(s, self.start), self.end)
        return x + beyond * cosine - d * sine, y + beyond * sine + d * cosine, heading

    def project(self, x: Numbers, y: Numbers, heading: Numeric) -> Pose:
        """Return s, d and relative heading in [-pi, pi) of poses: the inverse of
        `place`.

        From the nearest sample, `STEPS` iterations along the bend find the point whose
        normal passes through the position.
        """
        xp = namespace(self.x, x, y)
        several = self.x.ndim > 1
        own_x = self.x[:, None] if several else self.x
        own_y = self.y[:, None] if several else self.y
        nearest = xp.argmin(
            (x[..., None] - own_x) ** 2 + (y[..., None] - own_y) ** 2, axis=-1
        )
        s = nearest * self.spacing + self.start
        for _ in range(STEPS):
            from_x, from_y, along, bend = self._at(s)
            beyond = s - xp.minimum(xp.maximum(s, self.start), self.end)
            ahead, aside = rotated(x - from_x, y - from_y, along)
            ahead = ahead - beyond
            step = ahead / xp.maximum(1 - aside * bend, TIGHTEST)
            s = s + step
        return (
            s,
            aside - bend * ahead * step / 2,
            wrapped(heading - along - bend * step),
        )

    def locate(self, points: Float[Any, "*points 2"]) -> tuple[Numbers, Numbers]:
        """Return s and d of points."""
        s, d, _ = self.project(points[..., 0], points[..., 1], 0.0)
        return s, d

    def bend(self, s: Numeric) -> Numbers:
        """Return the curvature [1/m]."""
        return self._at(s)[3]

    def part(self, low: int, high: int) -> "Curve":
        """Return the part of the curve between two samples, with the same coordinates."""
        part = jax.tree.map(lambda values: values[..., low:high], self)
        return replace(part, start=self.start + low * self.spacing)

    def _at(self, s: Numeric) -> list[Numbers]:
        """Interpolate x, y, heading and curvature; several curves are interpolated row
        by row.
        """
        low, share = _between(np.shape(self.x)[-1], s, self.start, self.spacing)
        xp = namespace(self.x, s)
        found = []
        for values in map(xp.asarray, (self.x, self.y, self.heading, self.curvature)):
            each = () if values.ndim == 1 else (np.arange(len(values))[:, None],)
            left = values[*each, low]
            found.append(left + share * (values[*each, low + 1] - left))
        found[3] = xp.where((s > self.start) & (s < self.end), found[3], 0.0)
        return found


def namespace(*arrays: object) -> ModuleType:
    """Return ``jax.numpy`` if any of the arrays is JAX's, ``numpy`` otherwise."""
    for array in arrays:
        if isinstance(array, jax.Array):
            return jnp
    return np


def wrapped(angle: Any) -> Any:
    """Return an angle in [-pi, pi)."""
    return (angle + pi) % (2 * pi) - pi


def rotated(x: Numbers, y: Numbers, heading: Numeric) -> tuple[Numbers, Numbers]:
    """Return the components of a vector along a heading and to the right of it."""
    xp = namespace(x, y, heading)
    cosine = xp.cos(heading)
    sine = xp.sin(heading)
    return x * cosine + y * sine, y * cosine - x * sine


def interpolate(
    values: Knots, s: Numeric, start: Numeric = -BEHIND, spacing: float = SPACING
) -> Numbers:
    """Interpolate values that belong to s = ``start``, ``start + spacing``, ...; keep
    the outermost beyond the ends.
    """
    low, share = _between(np.shape(values)[-1], s, start, spacing)
    values = namespace(values, s).asarray(values)
    return values[..., low] * (1 - share) + values[..., low + 1] * share


def _between(
    samples: int, s: Numeric, start: Numeric, spacing: float
) -> tuple[Numbers, Numbers]:
    """Return the number of the sample before s, and the share of the way from it to the
    next one.
    """
    xp = namespace(s)
    position = xp.minimum(xp.maximum((s - start) / spacing, 0.0), samples - 1.0)
    low = xp.minimum(position.astype(int), samples - 2)
    return low, position - low


def arc_lengths(positions: Rows) -> Float[np.ndarray, "samples"]:
    """Return the distance along a line from its first point to each point [m], given
    rows of x and y.
    """
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(positions)))])


def resample(rows: Rows, spacing: float) -> Rows:
    """Interpolate the rows of a line at equal distances along it; the first two rows
    are x and y [m].
    """
    along = arc_lengths(rows[:2])
    even = np.arange(0.0, along[-1], spacing)
    return np.stack([np.interp(even, along, row) for row in rows])
