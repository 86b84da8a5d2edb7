"""A curve as arrays of a fixed shape, and coordinates along it and across it.

Path coordinates are (s, d): s along the path, d to its right [m]. World coordinates are highway-env's: y points to the
right of x.
"""

from dataclasses import dataclass
from math import pi
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import Numbers

SPACING = 2.0
"""Distance between knots of a path [m]."""

BEHIND = 20.0
"""Length of a path behind the car that follows it [m]; the car is near s = 0."""

Knots = Float[Any, "*paths knots"]
Pose = tuple[Numbers, Numbers, Numbers]
"""x, y and heading in world coordinates, or s, d and heading in those of a path."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Path:
    """A curve, sampled every `SPACING` metres from s = -`BEHIND` on.

    Attributes:
        x, y: position [m], world coordinates.
        heading: of the curve, unwrapped [rad].
        curvature: of the curve, positive to the right [1/m].
    """

    x: Knots
    y: Knots
    heading: Knots
    curvature: Knots


def wrapped(angle: Any) -> Any:
    """Return an angle in [-pi, pi)."""
    return (angle + pi) % (2 * pi) - pi


def interpolate(values: Knots, s: Numbers) -> Numbers:
    """Interpolate values at the knots of a path linearly; beyond its ends, the outermost are kept."""
    knots = np.shape(values)[-1]
    position = jnp.clip((s + BEHIND) / SPACING, 0.0, knots - 1.0)
    low = jnp.minimum(position.astype(int), knots - 2)
    share = position - low
    values = jnp.asarray(values)
    return values[..., low] * (1 - share) + values[..., low + 1] * share


def place(path: Path, s: Numbers, d: Numbers) -> Pose:
    """Return x, y and the path's heading at road coordinates; beyond its ends, the path goes straight on."""
    heading = interpolate(path.heading, s)
    beyond = s - jnp.clip(s, -BEHIND, _end(path))
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    x = interpolate(path.x, s) + beyond * cosine - d * sine
    y = interpolate(path.y, s) + beyond * sine + d * cosine
    return x, y, heading


def locate(path: Path, x: Numbers, y: Numbers, heading: Numbers) -> Pose:
    """Return s, d and the heading relative to the path of poses in world coordinates: the inverse of `place`.

    From the nearest knot, two Newton steps find where the normal of the path passes through the position. The heading
    is wrapped to [-pi, pi).
    """
    nearest = jnp.argmin((x[..., None] - path.x) ** 2 + (y[..., None] - path.y) ** 2, axis=-1)
    s = nearest * SPACING - BEHIND
    for _ in range(2):
        ahead, aside, _ = _offset(path, s, x, y)
        s = s + ahead / jnp.maximum(1 - aside * bend(path, s), 0.2)
    _, d, along = _offset(path, s, x, y)
    return s, d, wrapped(heading - along)


def bend(path: Path, s: Numbers) -> Numbers:
    """Return the path's curvature; beyond its ends, it goes straight on."""
    return jnp.where((s > -BEHIND) & (s < _end(path)), interpolate(path.curvature, s), 0.0)


def _end(path: Path) -> float:
    return (np.shape(path.x)[-1] - 1) * SPACING - BEHIND


def _offset(path: Path, s: Numbers, x: Numbers, y: Numbers) -> Pose:
    """Return how far positions are ahead and to the right of the path at s [m], and the path's heading there."""
    from_x, from_y, along = place(path, s, jnp.zeros_like(s))
    return *rotated(x - from_x, y - from_y, along), along


def rotated(x: Numbers, y: Numbers, heading: Numbers) -> tuple[Numbers, Numbers]:
    """Return a vector's parts along a heading and to the right of it."""
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    return x * cosine + y * sine, y * cosine - x * sine
