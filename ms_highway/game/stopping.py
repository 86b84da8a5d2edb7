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
SOFT = 0.2  # from which on what a car is late or aligned by counts nearly in proportion


def stopping_cost(scene: Scene, braking: Scalar, own: Motion) -> Scalar:
    """Return how much too late, and how squarely, a car would stop before the obstacles, ``sum r^2`` with::

        r = soft(d) soft(1 - (dy / w)^2) s,  soft(z) = max(z, 0)^2 / (max(z, 0) + 0.2)
        d = (v^2 / (2 b) + l - dx) / car length + room

    half-way through its motion. The distance of the centres is (dx, dy); bodies touch at the length l, and pass each
    other at the width w; s falls smoothly from 1 at ``dx = l`` to 0 at ``dx = -l``, where the obstacle is passed.

    Args:
        scene: obstacles and sizes of bodies.
        braking: deceleration b; without a limit, only the gap counts.
        own: motion of the car, arrays [steps].
    """
    return jnp.sum(_lateness(scene, braking, jnp.stack(own)[:, _half_way(own)]) ** 2)


def stopping_curvature(scene: Scene, braking: Scalar, own: Motion) -> Float[jax.Array, "steps 5 5"]:
    """Return the Gauss-Newton form ``sum 2 dr dr^T`` of `stopping_cost`, in x, y, cosine, sine and speed of each step.

    It is zero but for the step half-way, and a continuous function of the motion, as r is smooth where it begins.
    """
    half = _half_way(own)
    slopes = jax.jacfwd(partial(_lateness, scene, braking))(jnp.stack(own)[:, half])
    return jnp.zeros((len(own.x), 5, 5)).at[half].set(2 * slopes.T @ slopes)


def _half_way(own: Motion) -> int:
    return (len(own.x) - 1) // 2


def _lateness(scene: Scene, braking: Scalar, moment: Float[jax.Array, "5"]) -> Float[jax.Array, "obstacles"]:
    """Return r for every obstacle."""
    x, y, _, _, speed = moment
    obstacle_x, obstacle_y = jnp.asarray(scene.obstacles).T
    length, width = (jnp.asarray(scene.car_size) + jnp.asarray(scene.obstacle_size)) / 2
    car, gap = jnp.asarray(scene.car_size)[0], obstacle_x - x
    late = _soft((speed**2 / (2 * braking) + length - gap) / car + ROOM)
    aligned = _soft(1 - ((y - obstacle_y) / width) ** 2)
    ahead = jnp.clip((gap / length + 1) / 2, 0.0, 1.0)
    return late * aligned * ahead**2 * (3 - 2 * ahead)


def _soft(excess: Float[jax.Array, "obstacles"]) -> Float[jax.Array, "obstacles"]:
    """Return the positive part, which begins as a square does."""
    positive = jnp.maximum(excess, 0.0)
    return positive**2 / (positive + SOFT)
