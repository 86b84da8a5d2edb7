"""Know where the corners of the robot's body are in bends.

The front swings out of the way of the rear axle there.
"""

from dataclasses import dataclass

import jax
from jax import numpy as jnp

from ms_highway.geometry.curve import BEHIND, SPACING, Knots, interpolate
from ms_highway.perception.scene import RoadScene, States
from ms_highway.runtime.arrays import Numbers, Numeric


@dataclass(frozen=True)
class SharpBends:
    """Set in which bends the rear axle drives inside the middle of its lane."""

    corner_margin: float = 0.2
    """Distance from the outer front corner to the edge of the lane below which a bend
    is sharp; for steering errors [m].
    """
    fade: float = 0.1
    """Excess of the corner's swing at which the middle of the body follows the middle
    of the lane [m].
    """
    nearby: float = 8.0
    """Distance before and behind a sharp bend within which the body is positioned as in
    it [m].
    """

    @property
    def knots(self) -> int:
        """Number of knots of a route within `nearby` of a knot, before and behind."""
        return 2 * round(self.nearby / SPACING) + 1


SHARP_BENDS = SharpBends()


def lateral_position(
    scene: RoadScene,
    states: States,
    ahead: Numeric,
    right: Numeric = 0.0,
) -> Numbers:
    """Return the lateral position of a point of the robot's body [m].

    The road bends away below the body. A point that is x along the road from the rear
    axle and y beside it lies ``y - x^2 k / (c + sqrt(c^2 + (k x)^2))`` beside a road of
    curvature k, where ``c = 1 - k y``.

    Args:
        scene: the road.
        states: of the robot, in road coordinates.
        ahead: distance of the point ahead of the rear axle [m].
        right: distance of the point to the right of the middle [m].
    """
    s, d, heading, _ = jnp.moveaxis(states, -1, 0)

    # The curvature k of the road, in the middle between the rear axle and the point.
    bend = interpolate(scene.route.curvature, s + ahead / 2)

    # The point relative to a straight road.
    cosine = jnp.cos(heading)
    sine = jnp.sin(heading)
    x = ahead * cosine - right * sine
    y = d + ahead * sine + right * cosine

    # y - x^2 k / (c + sqrt(c^2 + (k x)^2)), c = 1 - k y
    c = 1 - bend * y
    root = jnp.sqrt(c**2 + (bend * x) ** 2)
    return y - bend * x**2 / (c + root)


def inward_shift_of(scene: RoadScene) -> Knots:
    """Return how far inside the middle of a lane the rear axle has to be [m].

    It is positive to the right. In most bends that is 0. Where the outer front corner
    would swing nearer than `SharpBends.corner_margin` to the edge of the lane, the
    middle of the body follows the middle of the lane instead of the rear axle, also
    shortly before and behind.

    Returns:
        An array [knots], at each knot of the route.
    """
    length, width = scene.size
    left, own, right = scene.lanes
    lane_spacing = jnp.maximum(own - left, right - own)
    half_lane = lane_spacing / 2
    room = half_lane - SHARP_BENDS.corner_margin

    # Where the body is while the rear axle is in the middle of the lane.
    s = SPACING * jnp.arange(len(own)) - BEHIND
    zero = jnp.zeros_like(s)
    in_middle = jnp.stack([s, zero, zero, zero], axis=-1)
    left_corner = -lateral_position(scene, in_middle, length, -width / 2)
    right_corner = lateral_position(scene, in_middle, length, width / 2)
    body_middle = lateral_position(scene, in_middle, length / 2)

    # Where the corner is too near, or soon will be, or was.
    excess = jnp.maximum(left_corner, right_corner) - room
    nearby_excess = jax.lax.reduce_window(
        excess, -jnp.inf, jax.lax.max, (SHARP_BENDS.knots,), (1,), "SAME"
    )
    sharpness = jnp.clip(nearby_excess / SHARP_BENDS.fade, 0.0, 1.0)
    return -body_middle * sharpness


def sharpest_bends(scene: RoadScene, inward_shift: Knots) -> Knots:
    """Return the curvature for which the robot has to be slow enough [1/m].

    There is one at each knot of the route. In sharp bends, in which the rear axle is
    inside its lane, see `inward_shift_of`, the robot steers in half its length before
    the bend.
    """
    bends = jnp.abs(scene.route.curvature)
    half_length = scene.size[0] / 2
    knots_of_half_length = jnp.round(half_length / SPACING).astype(int)
    last_knot = len(bends) - 1
    knots_ahead = jnp.minimum(jnp.arange(len(bends)) + knots_of_half_length, last_knot)
    bends_ahead = jnp.where(inward_shift == 0, 0.0, bends[knots_ahead])
    return jnp.maximum(bends, bends_ahead)
