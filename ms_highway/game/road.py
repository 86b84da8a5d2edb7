"""A stretch of any road as arrays of fixed shapes: the robot's route, its lanes and edges, and the traffic on it.

Road coordinates are (s, d): s along a path, d to its right [m]. A state is ``(s, d, heading, speed)``, the heading
relative to the path. World coordinates are highway-env's: y points to the right of x.
"""

from dataclasses import dataclass
from math import pi
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.runtime.arrays import Car, Numbers, Scalar, State

SPACING = 2.0
"""Distance between knots of a path [m]."""

BEHIND = 20.0
"""Length of a path behind the car that follows it [m]; the car is near s = 0."""

KNOTS, TRAFFIC_KNOTS = 96, 64
"""Number of knots of the robot's route, 20 m behind to 170 m ahead, and of the paths of others, to 106 m ahead."""

LANES = 3
"""Lanes that the robot can choose: left of its own, its own, right of it."""

TRAFFIC = 20
"""Number of paths of others that plans look at."""

Knots = Float[Any, "*paths knots"]
Sizes = Float[Any, "*cars 2"]
Traffic = Float[Any, "traffic"]
Flags = Bool[Any, "traffic"]
Places = Int[Any, "traffic"]
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadScene:
    """What the robot sees of a road.

    Attributes:
        route: smooth way along the lanes that the robot follows.
        lanes: lateral positions of the centres of `LANES` lanes at the knots of the route: left, own, right [m].
        open: where each of them may be driven on.
        edges: lateral positions of the left and the right edge of the road at the knots [m].
        paved: the same of all lanes side by side, those included that lead elsewhere or the other way [m].
        changes: changes of lane to the right that the goal asks for from each lane, negative to the left.
        room: distance left for them [m]; infinite where the goal asks for none.
        robot: state of the middle of the robot's rear axle.
        size: length and width of the robot [m].
        applied: curvature and acceleration that the robot has applied last [1/m, m/s^2].
        paths: of others, one for each way that they may take, `TRAFFIC` of them.
        states: of others on these paths: their centres.
        sizes: length and width of others [m].
        present: which of the paths are in use.
        limits: speed limits of others [m/s].
        leaders: place of the car ahead of each other car on its path, -1 without one.
        gaps: distance of centres to that car [m].
        owners: number of the car that each path belongs to, in the order of distance; -1 where none does.
        names: number of the car that each path belongs to, the same as long as the car is in sight; -1 where none does.
        moving: which of the others can move; obstacles cannot.
        accelerations: of others since the last look, 0 of new ones [m/s^2].
    """

    route: Path
    lanes: Knots
    open: Knots
    edges: Knots
    paved: Knots
    changes: Numbers
    room: Scalar
    robot: Car
    size: Sizes
    applied: Sizes
    paths: Path
    states: State
    sizes: Sizes
    present: Flags
    limits: Traffic
    leaders: Places
    gaps: Traffic
    owners: Places
    names: Places
    moving: Flags
    accelerations: Traffic

    @property
    def askew(self) -> Sizes:
        """Angle of each of the others to its path that it keeps: its own if it cannot move, none if it drives."""
        return jnp.where(self.moving, 0.0, self.states[:, 2])[:, None]

    @property
    def reach(self) -> Sizes:
        """Distance of centres at which the robot and each other car touch, along and across [m]."""
        turned = jnp.abs(jnp.sin(self.askew)) * self.sizes[:, ::-1]
        return (self.size + jnp.abs(jnp.cos(self.askew)) * self.sizes + turned) / 2


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
