"""The risk of a collision has the value and the derivatives of its formula."""

from functools import partial

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
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.jax_settings import double_precision


def by_formula(scene, cars):
    """The risk of the first of some cars: nine points of its body, in the frame of every other car and obstacle."""
    x, y, heading, _ = cars[0]
    along, across = (jnp.concatenate([scene.corner * CORNERS, MIDDLES]) * jnp.asarray(scene.car_size)).T
    points = jnp.stack(
        [
            x + jnp.cos(heading) * along - jnp.sin(heading) * across,
            y + jnp.sin(heading) * along + jnp.cos(heading) * across,
        ]
    )

    def closeness(place, heading, size, sharpness):
        dx, dy = points - place[:, None]
        ahead, aside = jnp.cos(heading) * dx + jnp.sin(heading) * dy, jnp.cos(heading) * dy - jnp.sin(heading) * dx
        return jnp.sum(jnp.exp(-sharpness * ((2 * ahead / size[0]) ** 2 + (2 * aside / size[1]) ** 2 - 1)))

    others = sum(closeness(car[:2], car[2], scene.car_size, CAR_SHARPNESS) for car in cars[1:])
    cones = (closeness(cone, 0.0, scene.obstacle_size, OBSTACLE_SHARPNESS) for cone in scene.obstacles)
    return others + OBSTACLE_SHARE * sum(cones, jnp.zeros(()))


def computed(scene, states):
    cars = observe(states)
    return collision_risk(scene, Motion(*(field[0] for field in cars)), Motion(*(field[1:] for field in cars)))


def test_the_risk_and_its_first_two_derivatives_are_those_of_the_formula(played):
    """Four cars are near a cone, in any direction."""
    scene = played("stay_back")[0].scene
    noise = np.random.default_rng(0).normal(0, [3, 3, 1, 2], (6, 4, 4))

    def derivatives(risk):
        kinds = risk, jax.grad(risk), jax.hessian(risk)
        return lambda cars: [kind(cars) for kind in kinds]

    def own(cars):
        return computed(scene, cars)[0]

    with double_precision():
        scene = jax.tree.map(partial(jnp.asarray, dtype=jnp.float64), scene)
        states = jnp.asarray(noise).at[..., :2].add(scene.obstacles[0])
        found = jit_quickly(jax.vmap(lambda cars: [*derivatives(own)(cars), jax.jacfwd(jax.jacfwd(own))(cars)]))(states)
        expected = jit_quickly(jax.vmap(derivatives(partial(by_formula, scene))))(states)
        found, expected = jax.device_get((found, [*expected, expected[-1]]))  # forward twice, or forward over reverse
    for derived, wanted in zip(found, expected, strict=True):
        assert abs(wanted).max() > 0.1, "the cars should be close"
        np.testing.assert_allclose(derived, wanted, rtol=1e-9, atol=1e-9 * abs(wanted).max())
