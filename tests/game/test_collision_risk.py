"""The risk of a collision has the value of its formula."""

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.collision_risk import (
    CAR_SHARPNESS,
    OBSTACLE_SHARE,
    OBSTACLE_SHARPNESS,
    collision_risk,
)
from ms_highway.game.dynamics import Motion, observe
from ms_highway.geometry.bodies import CORNERS, MIDDLES


def by_formula(scene, cars):
    """The risk of the first of some cars: nine points of its body, in the frame of every other car and obstacle."""
    x, y, heading, _ = cars[0]
    along, across = (np.concatenate([scene.corner * CORNERS, MIDDLES]) * scene.car_size).T
    points = np.stack(
        [
            x + np.cos(heading) * along - np.sin(heading) * across,
            y + np.sin(heading) * along + np.cos(heading) * across,
        ]
    )

    def closeness(place, heading, size, sharpness):
        dx, dy = points - place[:, None]
        ahead, aside = np.cos(heading) * dx + np.sin(heading) * dy, np.cos(heading) * dy - np.sin(heading) * dx
        return np.sum(np.exp(-sharpness * ((2 * ahead / size[0]) ** 2 + (2 * aside / size[1]) ** 2 - 1)))

    others = sum(closeness(car[:2], car[2], scene.car_size, CAR_SHARPNESS) for car in cars[1:])
    cones = (closeness(cone, 0.0, scene.obstacle_size, OBSTACLE_SHARPNESS) for cone in scene.obstacles)
    return others + OBSTACLE_SHARE * sum(cones)


def test_the_risk_of_a_collision_is_that_of_its_formula(played):
    """Four cars are near a cone, in any direction. Derivatives are JAX's, see the slopes of all features."""
    scene = played("stay_back")[0].scene
    states = np.random.default_rng(0).normal(0, [3, 3, 1, 2], (6, 4, 4))
    states[..., :2] += scene.obstacles[0]

    @jax.jit
    def risks(states):
        cars = observe(jnp.moveaxis(states, 1, 0))
        return collision_risk(scene, Motion(*(field[0] for field in cars)), Motion(*(field[1:] for field in cars)))[0]

    expected = [by_formula(scene, cars) for cars in states]
    assert max(expected) > 0.1, "the cars should be close"
    np.testing.assert_allclose(risks(jnp.float32(states)), expected, rtol=1e-4, atol=1e-4)
