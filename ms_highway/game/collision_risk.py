"""Measure how close a car is to colliding: a smooth risk, and an indicator."""

from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class RiskSettings:
    """Set how the risk of a collision falls with the distance D - 1 from a body.

    Risk and indicator are the paper's; the smooth indicator is ours.
    """

    car_sharpness: float = 1.5
    """Rate at which the risk of a car falls with D - 1."""
    obstacle_sharpness: float = 4.0
    """Rate at which the risk of an obstacle falls with D - 1."""
    obstacle_share: float = 0.5
    """Weight of an obstacle's risk relative to a car's."""
    smooth_margin: float = 0.6
    """D - 1 below which the smooth indicator rises: before bodies touch, at 0."""
    smooth_factor: float = 0.3
    """Factor of the cube of the distance below that margin in the smooth indicator."""


RISK = RiskSettings()


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
    """Return the other cars, arrays [others, *times], and the obstacles.

    Obstacles are parallel to x.
    """
    cars = len(others.x)
    obstacles = len(scene.obstacles)
    times = others.x.shape[1:]
    of_cars = jnp.stack([*jnp.asarray(scene.car_size), 1.0, RISK.car_sharpness])
    if not obstacles:
        return Bodies(others, *of_cars)

    # Obstacles stand: their motion is x, y, cosine 1, sine 0 and speed 0 at all times.
    ones = [1] * len(times)
    x, y = jnp.asarray(scene.obstacles).T.reshape(2, -1, *ones)
    standing = (
        jnp.broadcast_to(part, (obstacles, *times)) for part in (x, y, 1.0, 0.0, 0.0)
    )
    motion = Motion(
        *(jnp.concatenate(parts) for parts in zip(others, standing, strict=True))
    )

    # Length, width, share and sharpness of each body, arrays [bodies, 1, *ones].
    of_obstacles = jnp.stack(
        [
            *jnp.asarray(scene.obstacle_size),
            RISK.obstacle_share,
            RISK.obstacle_sharpness,
        ]
    )
    is_car = (np.arange(cars + obstacles) < cars).reshape(-1, 1, *ones)
    of_bodies = (
        jnp.where(is_car, of_car, of_obstacle)
        for of_car, of_obstacle in zip(of_cars, of_obstacles, strict=True)
    )
    return Bodies(motion, *of_bodies)


def _ellipse_distances(
    scene: Scene,
    own: Motion,
    bodies: Bodies,
) -> Float[jax.Array, "bodies points *times"]:
    """Return the `ellipse_distance` D - 1 from points of the car to other bodies."""
    points = body_points(jnp.asarray(scene.car_size), scene.corner)
    other = bodies.motion[:4]
    return jnp.asarray(
        ellipse_distance(own[:4], points, other, bodies.length, bodies.width)
    )


def touches(
    scene: Scene,
    own: Motion,
    others: Motion,
    clearance: float = 0.0,
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
    distance = _ellipse_distances(wider, own, bodies_around(wider, others))
    return (distance < 0).any(axis=(0, 1))


def collision_risk(
    scene: Scene,
    own: Motion,
    others: Motion,
    smooth: bool = False,
) -> tuple[Times, Times]:
    """Return the risk of a collision, and the indicator of a collision.

    The indicator is 1 where any point has D < 1, else 0. With the `ellipse_distance`
    D - 1 from nine points of the car's body to all cars and obstacles::

        risk = sum over cars and points of exp(-1.5 (D - 1))
               + sum over obstacles and points of exp(-4 (D - 1)) / 2

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
    distance = _ellipse_distances(scene, own, bodies)  # D - 1 [bodies, points, *times]
    closeness = bodies.share * jnp.exp(-bodies.sharpness * distance)

    if scene.bodies_collide:
        risk = jnp.sum(closeness, axis=(0, 1))
        if smooth:
            return risk, jnp.zeros_like(risk)
        indicator = jax.lax.stop_gradient(overlap(scene, own, others))
        return risk, indicator.astype(closeness.dtype)

    if smooth:
        depth = jnp.maximum(RISK.smooth_margin - distance, 0.0)
        touching = RISK.smooth_factor * depth**3
    else:
        touching = jax.lax.stop_gradient(distance < 0).astype(closeness.dtype)

    # Both sums in one kernel: XLA reads the distances once.
    risk, indicator = jnp.sum(jnp.stack([closeness, touching], axis=2), axis=(0, 1))
    if smooth:
        return risk, indicator
    return risk, (indicator > 0).astype(closeness.dtype)
