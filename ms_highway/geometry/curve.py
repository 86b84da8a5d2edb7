"""Curves, and coordinates along and across them, for arrays of NumPy and of JAX.

Curve coordinates are (s, d): s along the curve, d to its right [m]. World coordinates
are highway-env's: y points to the right of x. In coordinates whose y points to the
left, d is to the left.
"""

from dataclasses import dataclass, field, replace
from math import pi
from types import ModuleType
from typing import ClassVar, Literal, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.runtime.arrays import Array, Numbers, Numeric

SPACING = 2.0
"""Default distance between the samples of a curve [m]."""

BEHIND = 20.0
"""Length of a scene's curve behind the car that follows it [m].

The car is near s = 0.
"""

Knots = Float[Array, "*curves samples"]
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

    iterations: ClassVar[int] = 2
    """Iterations of a projection from the nearest sample: they leave millimetres."""
    nearest_centre: ClassVar[float] = 0.2
    """Least distance of a position from a bend's centre, as a share of the radius."""

    x: Knots
    y: Knots
    heading: Knots
    curvature: Knots
    start: Numeric = field(default=-BEHIND, metadata={"static": True})
    spacing: float = field(default=SPACING, metadata={"static": True})

    @classmethod
    def through(cls, x: Knots, y: Knots, spacing: float) -> "Curve":
        """Return the curve from s = 0 through evenly spaced positions.

        See `resample` for such positions.
        """
        order: Literal[1, 2] = 2 if len(x) > 2 else 1  # two points have one slope
        along = np.gradient(x, edge_order=order)
        aside = np.gradient(y, edge_order=order)
        heading = np.unwrap(np.arctan2(aside, along))
        curvature = np.gradient(heading, spacing)
        return cls(x, y, heading, curvature, start=0.0, spacing=spacing)

    @property
    def end(self) -> Numeric:
        """Return s of the last sample [m]."""
        samples = np.shape(self.x)[-1]
        return self.start + (samples - 1) * self.spacing

    def interpolate(self, values: Knots, s: Numeric) -> Numbers:
        """Interpolate values that belong to the samples.

        Beyond the ends, the outermost values continue.
        """
        return interpolate(values, s, self.start, self.spacing)

    def place(self, s: Numeric, d: Numeric) -> Pose:
        """Return x, y and the curve's heading at curve coordinates."""
        x, y, heading, _ = self._at(s)
        xp = namespace(heading)
        cosine = xp.cos(heading)
        sine = xp.sin(heading)

        # Along the curve, which goes straight on beyond its ends.
        beyond = self._beyond_ends(s)
        along_x = x + beyond * cosine
        along_y = y + beyond * sine

        # Then to the right of it.
        return along_x - d * sine, along_y + d * cosine, heading

    def project(self, x: Numbers, y: Numbers, heading: Numeric) -> Pose:
        """Return s, d and relative heading in [-pi, pi) of poses.

        It is the inverse of `place`. From the nearest sample, some iterations along the
        bend find the point whose normal passes through the position.
        """
        xp = namespace(self.x, x, y)

        # The nearest sample of each position's own curve.
        several = self.x.ndim > 1
        own_x = self.x[:, None] if several else self.x
        own_y = self.y[:, None] if several else self.y
        dx = x[..., None] - own_x  # [*positions, samples]
        dy = y[..., None] - own_y
        nearest = xp.argmin(dx**2 + dy**2, axis=-1)
        s = nearest * self.spacing + self.start

        # Along a bend, s advances faster than a position inside of it moves.
        for _ in range(self.iterations):
            from_x, from_y, along, bend = self._at(s)
            beyond = self._beyond_ends(s)
            ahead, d = rotated(x - from_x, y - from_y, along)
            ahead = ahead - beyond
            radius_share = xp.maximum(1 - d * bend, self.nearest_centre)
            step = ahead / radius_share
            s = s + step

        # d and heading at the last s, by the bend up to there.
        d_at_s = d - bend * ahead * step / 2
        turned = heading - along - bend * step
        return s, d_at_s, wrapped(turned)

    def locate(self, points: Float[Array, "*points 2"]) -> tuple[Numbers, Numbers]:
        """Return s and d of points."""
        s, d, _ = self.project(points[..., 0], points[..., 1], 0.0)
        return s, d

    def bend(self, s: Numeric) -> Numbers:
        """Return the curvature [1/m]."""
        return self._at(s)[3]

    def part(self, low: int, high: int) -> "Curve":
        """Return the part of the curve between two samples, in the same coordinates."""
        part = jax.tree.map(lambda values: values[..., low:high], self)
        return replace(part, start=self.start + low * self.spacing)

    def _beyond_ends(self, s: Numeric) -> Numbers:
        """Return how far s is beyond the end, or before the start if negative [m]."""
        xp = namespace(self.x, s)
        on_curve = xp.minimum(xp.maximum(s, self.start), self.end)
        return s - on_curve

    def _at(self, s: Numeric) -> list[Numbers]:
        """Interpolate x, y, heading and curvature at s.

        Several curves are interpolated row by row.
        """
        samples = np.shape(self.x)[-1]
        low, share = _between(samples, s, self.start, self.spacing)
        xp = namespace(self.x, s)
        rows: tuple[np.ndarray, ...] = ()
        if self.x.ndim > 1:
            rows = (np.arange(len(self.x))[:, None],)

        found = []
        for values in (self.x, self.y, self.heading, self.curvature):
            array = xp.asarray(values)
            before = array[*rows, low]
            after = array[*rows, low + 1]
            found.append(before + share * (after - before))

        # Beyond its ends, the curve is straight.
        x, y, heading, curvature = found
        within = (s > self.start) & (s < self.end)
        return [x, y, heading, xp.where(within, curvature, 0.0)]


def namespace(*arrays: object) -> ModuleType:
    """Return ``jax.numpy`` if any of the arrays is JAX's, ``numpy`` otherwise."""
    for array in arrays:
        if isinstance(array, jax.Array):
            return jnp
    return np


Angle = TypeVar("Angle", float, np.ndarray, jax.Array, Numeric)


def wrapped(angle: Angle) -> Angle:
    """Return an angle in [-pi, pi)."""
    return (angle + pi) % (2 * pi) - pi


def rotated(x: Numbers, y: Numbers, heading: Numeric) -> tuple[Numbers, Numbers]:
    """Return the components of a vector along a heading and to the right of it."""
    xp = namespace(x, y, heading)
    cosine = xp.cos(heading)
    sine = xp.sin(heading)
    along = x * cosine + y * sine
    to_right = y * cosine - x * sine
    return along, to_right


def interpolate(
    values: Knots,
    s: Numeric,
    start: Numeric = -BEHIND,
    spacing: float = SPACING,
) -> Numbers:
    """Interpolate values that belong to s = ``start``, ``start + spacing``, ...

    Beyond the ends, the outermost values continue.
    """
    samples = np.shape(values)[-1]
    low, share = _between(samples, s, start, spacing)
    array = namespace(values, s).asarray(values)
    before = array[..., low]
    after = array[..., low + 1]
    return before * (1 - share) + after * share


def _between(
    samples: int,
    s: Numeric,
    start: Numeric,
    spacing: float,
) -> tuple[Int[Array, "..."] | np.integer, Numbers]:
    """Return the index of the sample before s, and the share of the way to the next."""
    xp = namespace(s)
    steps = (s - start) / spacing
    position = xp.minimum(xp.maximum(steps, 0.0), samples - 1.0)
    low = xp.minimum(position.astype(int), samples - 2)
    return low, position - low


def arc_lengths(positions: Rows) -> Float[np.ndarray, "samples"]:
    """Return the distance along a line from its first point to each point [m].

    Args:
        positions: rows of x and y.
    """
    dx, dy = np.diff(positions)
    lengths = np.hypot(dx, dy)
    return np.concatenate([[0.0], np.cumsum(lengths)])


def resample(rows: Rows, spacing: float) -> Float[np.ndarray, "rows resampled"]:
    """Interpolate the rows of a line at equal distances along it.

    The first two rows are x and y [m].
    """
    along = arc_lengths(rows[:2])
    even = np.arange(0.0, along[-1], spacing)
    resampled = [np.interp(even, along, row) for row in rows]
    return np.stack(resampled)
