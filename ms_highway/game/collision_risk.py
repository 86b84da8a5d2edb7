"""Measure how close a car is to colliding: distances of its body to others, a smooth
risk, and an indicator.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.contact import overlap
from ms_highway.game.dynamics import Motion
from ms_highway.game.scene import Scene
from ms_highway.geometry.bodies import body_points, ellipse_distance
from ms_highway.runtime.arrays import Array, Times

CAR_SHARPNESS = 1.5
OBSTACLE_SHARPNESS = 4.0
OBSTACLE_SHARE = 0.5  # weight of an obstacle's risk relative to a car's
SMOOTH_MARGIN = 0.6  # D - 1 below which the smooth indicator rises
SMOOTH_FACTOR = 0.3  # of the cube of the distance below that margin


class Bodies(NamedTuple):
    """Bodies that a car may collide with: cars, then obstacles.

    Attributes:
        motion: arrays [bodies, *times].
        length, width: of each, arrays [bodies, *ones] with an axis of points and those
            of times, or numbers for all.
        share, sharpness: of the risk of each, likewise.
    """

    motion: Motion
    length: Array
    width: Array
    share: Array
    sharpness: Array


def bodies_around(scene: Scene, others: Motion) -> Bodies:
    """Return the other cars, arrays [others, *times], and the obstacles, which are
    parallel to x.
    """
    cars = len(others.x)
    obstacles = len(scene.obstacles)
    times = others.x.shape[1:]
    numbers = jnp.stack([*jnp.asarray(scene.car_size), 1.0, CAR_SHARPNESS])
    if not obstacles:
        return Bodies(others, *numbers)
    x, y = jnp.asarray(scene.obstacles).T.reshape(2, -1, *[1] * len(times))
    standing = (
        jnp.broadcast_to(part, (obstacles, *times)) for part in (x, y, 1.0, 0.0, 0.0)
    )
    motion = Motion(
        *(jnp.concatenate(parts) for parts in zip(others, standing, strict=True))
    )
    of_obstacles = jnp.stack(
        [*jnp.asarray(scene.obstacle_size), OBSTACLE_SHARE, OBSTACLE_SHARPNESS]
    )
    is_car = (np.arange(cars + obstacles) < cars).reshape(-1, 1, *[1] * len(times))
    return Bodies(
        motion,
        *(
            jnp.where(is_car, of_car, of_obstacle)
            for of_car, of_obstacle in zip(numbers, of_obstacles, strict=True)
        ),
    )


def _distance(
    scene: Scene, own: Motion, bodies: Bodies
) -> Float[jax.Array, "bodies points *times"]:
    """Return the `ellipse_distance` D - 1 from the points of the car's body to other
    bodies.
    """
    points = body_points(jnp.asarray(scene.car_size), scene.corner)
    return ellipse_distance(
        own[:4], points, bodies.motion[:4], bodies.length, bodies.width
    )


def touches(
    scene: Scene, own: Motion, others: Motion, clearance: float = 0.0
) -> Bool[jax.Array, "*times"]:
    """Return whether the car collides with another body, by the scene's ``contact``.

    Args:
        scene: obstacles and sizes of bodies.
        own: motion of the car, arrays [*times].
        others: motion of the other cars, arrays [others, *times].
        clearance: by which all bodies are longer and wider than they are [m].
    """
    if scene.bodies_collide:
        return overlap(scene, own, others, clearance)
    wider = replace(
        scene,
        car_size=jnp.asarray(scene.car_size) + clearance,
        obstacle_size=jnp.asarray(scene.obstacle_size) + clearance,
    )
    distance = _distance(wider, own, bodies_around(wider, others))
    return (distance < 0).any(axis=(0, 1))


def collision_risk(
    scene: Scene, own: Motion, others: Motion, smooth: bool = False
) -> tuple[Times, Times]:
    """Return the risk of a collision, and the indicator of a collision: 1 where any
    point has D < 1, else 0.

    With the `ellipse_distance` D - 1 from nine points of the car's body to all cars and
    obstacles::

        risk = sum over cars and points of exp(-1.5 (D - 1)) + sum over obstacles and points of exp(-4 (D - 1)) / 2

    The indicator has no gradient. The smooth indicator is the sum over cars, obstacles
    and points of ``0.3 max(1.6 - D, 0)^3``, which begins to rise before bodies touch.

    Where a scene's ``contact`` is ``bodies``, the indicator is 1 where bodies overlap,
    and the smooth one is 0: plans pay the `ms_highway.game.contact.contact_cost`
    instead.

    Args:
        scene: obstacles and sizes of bodies.
        own: motion of the car, arrays [*times].
        others: motion of the other cars, arrays [others, *times].
        smooth: whether the indicator is smooth.
    """
    bodies = bodies_around(scene, others)
    distance = _distance(scene, own, bodies)
    close = bodies.share * jnp.exp(-bodies.sharpness * distance)
    if scene.bodies_collide:
        risk = jnp.sum(close, axis=(0, 1))
        if smooth:
            return risk, jnp.zeros_like(risk)
        indicator = jax.lax.stop_gradient(overlap(scene, own, others))
        return risk, indicator.astype(close.dtype)
    if smooth:
        touching = SMOOTH_FACTOR * jnp.maximum(SMOOTH_MARGIN - distance, 0.0) ** 3
    else:
        touching = jax.lax.stop_gradient(distance < 0).astype(close.dtype)
    risk, indicator = jnp.sum(jnp.stack([close, touching], axis=2), axis=(0, 1))
    return risk, indicator if smooth else (indicator > 0).astype(close.dtype)
