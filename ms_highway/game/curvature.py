"""Approximate minus the Hessian of a reward along a motion by a positive semidefinite matrix, without eigenvalues.

Most features are concave functions of quantities that are taken as linear in the motion (Gauss-Newton), so their sum is
positive semidefinite. Closeness to a body differs: it is a convex cost of a distance that is a square itself, so the
reward bends upwards between the two ways around the body. The magnitude of this part is taken, as in the saddle-free
Newton step of Dauphin et al. (2014). The matrix C then bounds the Hessian H of closeness, ``-C <= H <= C``, and a step
``C^-1 g`` at most doubles the difference between two plans. Smooth indicators of a lane, induced braking and
user-defined features have no such form: they are left out, and plans take short steps up them.
"""

from functools import partial

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.collision_risk import SMOOTH_FACTOR, SMOOTH_MARGIN, Bodies, bodies_around
from ms_highway.game.dynamics import Motion
from ms_highway.game.features import attention, depth_off_road
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.game.stopping import lateness
from ms_highway.geometry.bodies import body_points
from ms_highway.numerics.second_derivatives import along_fields
from ms_highway.runtime.arrays import Scalar, Trajectory

Bends = Float[jax.Array, "fields fields steps"]
Points = Float[jax.Array, "2 points steps"]


def curvature(
    scene: Scene, parameters: Reward, own: Trajectory, others: Motion, braking: Scalar | None = None
) -> Bends:
    """Return a convex matrix in place of minus the Hessian of a car's smooth reward, in x, y, cosine, sine and speed.

    For costs ``c_j(q_j)`` of quantities q_j, it is ``sum_j max(c_j'', 0) (dq_j/ds) (dq_j/ds)^T``. For the distances D
    of `ms_highway.game.collision_risk`, ``|c_j'| d2D_j/ds2`` is added.

    Args:
        scene: road, obstacles and bodies.
        parameters: the reward.
        own: motion of the car.
        others: motion of all others, arrays [others, steps].
        braking: deceleration that `ms_highway.game.stopping` counts on; None without its cost.
    """
    along, aside = body_points(jnp.asarray(scene.car_size), scene.corner).T[..., None]

    def body(path: Trajectory) -> Points:
        x, y, cosine, sine, _ = path
        return jnp.stack([x + cosine * along - sine * aside, y + sine * along + cosine * aside])

    points, moved = along_fields(body, own)
    _, slopes = along_fields(partial(_closeness, parameters, bodies_around(scene, others)), points)
    bends = jnp.sum(slopes[:, None] * slopes, axis=(2, 3))  # one kernel, unlike an einsum
    close = jnp.einsum("fapt,abpt,gbpt->fgt", moved, bends, moved)
    _, slopes = along_fields(partial(_residuals, scene, parameters, others, braking), own)
    return 2 * (close + jnp.sum(slopes[:, None] * slopes, axis=2))


def _residuals(
    scene: Scene, parameters: Reward, others: Motion, braking: Scalar | None, path: Trajectory
) -> Float[jax.Array, "residuals steps"]:
    """Return quantities whose squares are, up to constants, the costs of features of the road and of traffic."""
    own, per_unit = Motion(*path), 1 / scene.length_unit
    weights = dict(zip(parameters.names, jnp.unstack(parameters.weights), strict=True))
    costs = [
        (weights["speed"], own.speed * own.cosine / parameters.speed_limit),
        (weights["lane_alignment"] + weights["target_lane"], own.y * per_unit),
        (-weights["off_road"], depth_off_road(scene, own, smooth=True) * per_unit),
    ]
    if scene.leader is not None:
        costs.append((weights["gap"], own.x * per_unit))
    if "headway" in weights:
        along, _, attended = attention(scene, own, others)
        ahead = jax.lax.stop_gradient(jnp.sqrt(jnp.where(along > 0, attended, 0.0).sum(axis=0)))
        costs.append((weights["headway"], ahead * (own.x + parameters.headway * own.speed) * per_unit))
        costs.append((weights["closing_speed"], ahead * own.speed / parameters.speed_limit))
    residuals = jnp.stack([jnp.sqrt(jnp.maximum(weight, 0.0)) * quantity for weight, quantity in costs])
    if braking is None:
        return residuals
    late = jnp.sqrt(parameters.price("collision")) * lateness(scene, braking, own)
    return jnp.concatenate([residuals, late])


def _closeness(parameters: Reward, bodies: Bodies, points: Points) -> Float[jax.Array, "3 bodies points steps"]:
    """Return quantities whose squares bend like closeness: the offset from a body along and across it, and D."""
    other = Motion(*(field[:, None] for field in bodies.motion))
    dx, dy = points[0] - other.x, points[1] - other.y
    ahead = (other.cosine * dx + other.sine * dy) / (bodies.length / 2)
    across = (other.cosine * dy - other.sine * dx) / (bodies.width / 2)
    distance = ahead**2 + across**2 - 1
    near = jax.lax.stop_gradient(distance)
    close = parameters.price("collision_risk") * bodies.share * jnp.exp(-bodies.sharpness * near)
    contact, depth = SMOOTH_FACTOR * parameters.price("collision"), jnp.maximum(SMOOTH_MARGIN - near, 0.0)
    fall = jnp.sqrt(bodies.sharpness * close + 3 * contact * depth**2)
    bend = jnp.sqrt(bodies.sharpness**2 * close / 2 + 3 * contact * depth)
    return jnp.stack([fall * ahead, fall * across, bend * distance])
