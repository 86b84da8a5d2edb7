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

from ms_highway.game.collision_risk import (
    CAR_SHARPNESS,
    CONTACT,
    NEAR,
    OBSTACLE_SHARE,
    OBSTACLE_SHARPNESS,
    body_points,
    obstacles_as_bodies,
)
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import attention, depth_off_road
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.game.stopping import stopping_curvature
from ms_highway.runtime.arrays import Scalar, unrolled_sum

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
    bent = bent.at[:, :4, :4].add(_bend_of_closeness(scene, own, others, scene.car_size, CAR_SHARPNESS, risk, contact))
    if len(scene.obstacles):
        bodies, share = obstacles_as_bodies(scene, own.x.ndim), OBSTACLE_SHARE * risk
        near = _bend_of_closeness(scene, own, bodies, scene.obstacle_size, OBSTACLE_SHARPNESS, share, contact)
        bent = bent.at[:, :4, :4].add(near)
    if braking is not None:
        bent += contact * stopping_curvature(scene, braking, own)
    return bent


def _bend_of_closeness(
    scene: Scene,
    own: Motion,
    bodies: Motion,
    size: Float[jax.Array, "2"],
    sharpness: float,
    risk: Scalar,
    contact: Scalar,
) -> Float[jax.Array, "times 4 4"]:
    """Return the part of `ms_highway.game.collision_risk` with bodies of a size, in x, y, cosine and sine."""
    px, py = body_points(scene)
    x, y, cosine, sine = (field[..., None] for field in own[:4])
    dx = (x + cosine * px - sine * py) - bodies.x[..., None]
    dy = (y + sine * px + cosine * py) - bodies.y[..., None]
    along, across = 4 / size[0] ** 2, 4 / size[1] ** 2
    turned, slant = bodies.cosine[..., None], bodies.sine[..., None]
    ahead, aside = turned * dx + slant * dy, turned * dy - slant * dx
    excess = along * ahead**2 + across * aside**2 - 1
    gx = 2 * (along * ahead * turned - across * aside * slant)
    gy = 2 * (along * ahead * slant + across * aside * turned)
    close, depth = risk * jnp.exp(-sharpness * excess), CONTACT * contact * jnp.maximum(NEAR - excess, 0.0)
    bend = sharpness**2 * close + 6 * depth
    fall = sharpness * close + 3 * depth * jnp.maximum(NEAR - excess, 0.0)
    # A point moves by a dx + b dy with (x, y, cosine, sine): first sum over bodies what belongs to dx and dy.
    one, zero = jnp.ones_like(px), jnp.zeros_like(px)
    a, b = jnp.stack([one, zero, px, -py]), jnp.stack([zero, one, py, px])
    pairs = [a[:, None] * a, a[:, None] * b + b[:, None] * a, b[:, None] * b]
    bodily = (
        along * turned**2 + across * slant**2,
        (along - across) * turned * slant,
        along * slant**2 + across * turned**2,
    )
    products = zip((gx * gx, gx * gy, gy * gy), bodily, strict=True)
    bent = [unrolled_sum(bend * square + 2 * fall * shape, axis=0) for square, shape in products]
    summed = jnp.concatenate(bent, axis=1) @ jnp.concatenate(pairs, axis=2).reshape(16, -1).T
    return summed.reshape(-1, 4, 4)
