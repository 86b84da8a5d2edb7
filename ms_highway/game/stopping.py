"""Keep room to stop: what plans for seconds pay where, half-way, they could no longer stop before an obstacle.

A horizon ends before an obstacle matters: without this cost a car drives as fast as pays until then, brakes as late as
tyres allow, and stands too close to the obstacle to steer around it.
"""

from functools import partial

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Scalar

ROOM = 0.8  # car lengths (4 m) left to an obstacle after a stop: room to steer around it


def stopping_cost(scene: Scene, braking: Scalar, own: Motion) -> Scalar:
    """Return how much too late, and how squarely, a car would stop before the obstacles ahead, ``sum r^2`` with::

        r = max(v^2 / (2 b) + l - dx, 0) / length  max(1 - (dy / w)^2, 0)

    half-way through its motion: dx and dy are the distances of the centres, l the length at which bodies touch, and
    `ROOM`, and w the width at which they pass each other.

    Args:
        scene: obstacles and sizes of bodies.
        braking: deceleration b.
        own: motion of the car, arrays [steps].
    """
    return jnp.sum(_lateness(scene, braking, own.x[0], _half_way(own)) ** 2)


def stopping_curvature(scene: Scene, braking: Scalar, own: Motion) -> Float[jax.Array, "steps 5 5"]:
    """Return the Gauss-Newton form ``sum 2 dr dr^T`` of `stopping_cost`, in x, y, cosine, sine and speed of each step.

    It is zero but for the step half-way.
    """
    slopes = jax.jacfwd(partial(_lateness, scene, braking, own.x[0]))(_half_way(own))
    steps = len(own.x)
    return jnp.zeros((steps, 5, 5)).at[(steps - 1) // 2].set(2 * slopes.T @ slopes)


def _half_way(own: Motion) -> Float[jax.Array, "5"]:
    return jnp.stack([field[(len(own.x) - 1) // 2] for field in own])


def _lateness(
    scene: Scene, braking: Scalar, passed: Scalar, moment: Float[jax.Array, "5"]
) -> Float[jax.Array, "obstacles"]:
    """Return r for every obstacle; 0 for those that the car has passed."""
    x, y, _, _, speed = moment
    obstacle_x, obstacle_y = jnp.asarray(scene.obstacles).T
    length, width = (jnp.asarray(scene.car_size) + jnp.asarray(scene.obstacle_size)) / 2
    unit = jnp.asarray(scene.car_size)[0]
    late = jnp.maximum(speed**2 / (2 * braking) + length + ROOM * unit - (obstacle_x - x), 0.0) / unit
    aligned = jnp.maximum(1 - ((y - obstacle_y) / width) ** 2, 0.0)
    return jnp.where(obstacle_x > passed, late * aligned, 0.0)
