"""Approximate how a reward bends along a motion by a convex matrix, without eigenvalues.

Most features are concave functions of quantities that count as linear in the motion (Gauss-Newton), so that the sum is
positive semidefinite. Closeness to a body is a convex cost of a distance that is a square itself: between two ways
round the body, it bends upwards. That part counts by its magnitude, as in the saddle-free Newton step of Dauphin et al.
(2014). So the matrix C bounds the Hessian H of closeness, ``-C <= H <= C``, and a step ``C^-1 g`` no more than doubles
the difference of two plans. What has no such form is left out: smooth indicators of a lane, induced braking, and
user-defined features, for which plans take short steps.
"""

from functools import partial

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.collision_risk import CONTACT, NEAR, bodies_around, body_distance
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import attention, depth_off_road
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.game.stopping import stopping_curvature
from ms_highway.geometry.bodies import body_points
from ms_highway.runtime.arrays import Scalar

Blocks = Float[jax.Array, "times 5 5"]


def curvature(scene: Scene, parameters: Reward, own: Motion, others: Motion, braking: Scalar | None = None) -> Blocks:
    """Return a convex matrix in place of minus the Hessian of a car's smooth reward, in x, y, cosine, sine and speed.

    With costs ``c_j(q_j)`` of quantities q_j, ``sum_j max(c_j'', 0) (dq_j/ds) (dq_j/ds)^T``; for the distances D of
    `ms_highway.game.collision_risk`, ``|c_j'| d2D_j/ds2`` is added.

    Args:
        scene: road, obstacles and bodies.
        parameters: the reward.
        own: motion of the car, arrays [times].
        others: motion of all others, arrays [others, times].
        braking: deceleration that `ms_highway.game.stopping` counts on; None where it costs nothing.
    """
    weights = dict(zip(parameters.names, jnp.unstack(parameters.weights), strict=True))
    per_unit, zero, one = 1 / scene.length_unit, jnp.zeros_like(own.x), jnp.ones_like(own.x)
    per_limit = 1 / parameters.speed_limit
    along_y = [zero, per_unit * one, zero, zero, zero]
    _, off_road = jax.vjp(partial(depth_off_road, scene, smooth=True), own)
    costs = [
        (weights["speed"], [zero, zero, per_limit * own.speed, zero, per_limit * own.cosine]),
        (weights["lane_alignment"] + weights["target_lane"], along_y),
        (-weights["off_road"], [per_unit * slope for slope in off_road(one)[0]]),
    ]
    if scene.leader is not None:
        costs.append((weights["gap"], [per_unit * one, zero, zero, zero, zero]))
    if "headway" in weights:
        along, _, attended = attention(scene, own, others)
        ahead = jnp.sqrt(jnp.where(along > 0, attended, 0.0).sum(axis=0))
        pace = -parameters.headway * per_unit * one
        costs.append((weights["headway"], [ahead * part for part in (-per_unit * one, zero, zero, zero, pace)]))
        costs.append((weights["closing_speed"], [zero, zero, zero, zero, per_limit * ahead]))
    factors = jnp.stack([2 * jnp.maximum(weight, 0.0) for weight, _ in costs])
    slopes = jnp.stack([jnp.stack(slope) for _, slope in costs])
    bent = jnp.einsum("j,jft,jgt->tfg", factors, slopes, slopes)
    risk, contact = parameters.price("collision_risk"), parameters.price("collision")
    bent = bent.at[:, :4, :4].add(_bend_of_closeness(scene, own, others, risk, contact))
    if braking is not None:
        bent += contact * stopping_curvature(scene, braking, own)
    return bent


def _bend_of_closeness(
    scene: Scene, own: Motion, others: Motion, risk: Scalar, contact: Scalar
) -> Float[jax.Array, "times 4 4"]:
    """Return the part of `ms_highway.game.collision_risk.collision_risk`, in x, y, cosine and sine.

    A point moves by ``M dz`` with z = (x, y, cosine, sine). The square D of its distance to a body with the ellipse
    matrix A has the slope ``2 A d`` in its offset d, and bends by ``2 A``.
    """
    bodies = bodies_around(scene, others)
    distance = body_distance(scene, own, bodies)
    close, depth = risk * bodies.share * jnp.exp(-bodies.sharpness * distance), jnp.maximum(NEAR - distance, 0.0)
    bend = bodies.sharpness**2 * close + 6 * CONTACT * contact * depth
    fall = bodies.sharpness * close + 3 * CONTACT * contact * depth**2
    other = Motion(*(field[:, None] for field in bodies.motion))
    points = body_points(jnp.asarray(scene.car_size), scene.corner)
    along, aside = points.T.reshape(2, 9, *[1] * own.x.ndim)
    dx = own.x + own.cosine * along - own.sine * aside - other.x
    dy = own.y + own.sine * along + own.cosine * aside - other.y
    per_length, per_width = 4 / bodies.length**2, 4 / bodies.width**2
    xx = per_length * other.cosine**2 + per_width * other.sine**2
    xy = (per_length - per_width) * other.cosine * other.sine
    yy = per_length * other.sine**2 + per_width * other.cosine**2
    slope_x, slope_y = 2 * (xx * dx + xy * dy), 2 * (xy * dx + yy * dy)
    products = (slope_x**2, xx), (slope_x * slope_y, xy), (slope_y**2, yy)
    bodily = jnp.stack([bend * slopes + 2 * fall * matrix for slopes, matrix in products], axis=1)
    bent = jnp.sum(bodily, axis=0)
    zero, one, (along, aside) = jnp.zeros(9), jnp.ones(9), points.T
    a, b = jnp.stack([one, zero, along, -aside]), jnp.stack([zero, one, aside, along])  # the rows of M, [4, points]
    pairs = jnp.stack([a[:, None] * a, a[:, None] * b + b[:, None] * a, b[:, None] * b])
    return (bent.reshape(27, -1).T @ jnp.moveaxis(pairs, -1, 1).reshape(27, 16)).reshape(-1, 4, 4)
