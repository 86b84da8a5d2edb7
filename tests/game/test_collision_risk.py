"""The risk of a collision has the value and the derivatives of its plain formula."""

from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.collision_risk import (
    CAR_SHARPNESS,
    OBSTACLE_SHARE,
    OBSTACLE_SHARPNESS,
    _body_points,
    _obstacles,
    collision_risk,
)
from ms_highway.game.dynamics import Motion, observe
from ms_highway.runtime.compilation import jit_quickly


def plain_collision_risk(scene, own, others):
    """The risk by its formula, with the derivatives that JAX finds."""
    x, y = _body_points(scene)
    cosine, sine = own.cosine[..., None], own.sine[..., None]
    point_x, point_y = own.x[..., None] + cosine * x - sine * y, own.y[..., None] + sine * x + cosine * y

    def closeness(bodies, size, sharpness):
        body_x, body_y, cosine, sine, _ = (field[..., None] for field in bodies)
        dx, dy = point_x - body_x, point_y - body_y
        along, across = cosine * dx + sine * dy, cosine * dy - sine * dx
        distance = (2 * along / size[0]) ** 2 + (2 * across / size[1]) ** 2
        return jnp.sum(jnp.exp(-sharpness * (distance - 1)), axis=(0, -1))

    obstacles = closeness(_obstacles(scene, own.x.ndim), scene.obstacle_size, OBSTACLE_SHARPNESS)
    return closeness(others, scene.car_size, CAR_SHARPNESS) + OBSTACLE_SHARE * obstacles


def close_together(played, scenario):
    """A scenario's scene, and states of all cars near its first obstacle or the human, in any direction."""
    game, state = played(scenario)
    random, around = np.random.default_rng(0), np.array(state[1])
    if len(game.scene.obstacles):
        around[:2] = game.scene.obstacles[0]
    states = around * [1, 1, 0, 1] + random.normal(0, [3, 3, 1, 2], (6, *state.shape))
    return game.scene, jnp.asarray(states)


def apart(states):
    cars = observe(states)
    return Motion(*(field[0] for field in cars)), Motion(*(field[1:] for field in cars))


@pytest.mark.parametrize("scenario", ["merger", "stay_back", pytest.param("give_way", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "derivative",
    [lambda f: f, jax.grad, jax.hessian, lambda f: jax.jacfwd(jax.jacfwd(f))],
    ids=["value", "gradient", "hessian", "forward over forward"],
)
def test_the_risk_and_its_first_two_derivatives_are_those_of_the_plain_formula(played, scenario, derivative):
    with jax.enable_x64(True):
        scene, states = jax.tree.map(partial(jnp.asarray, dtype=jnp.float64), close_together(played, scenario))
        ours = jit_quickly(jax.vmap(derivative(lambda cars: collision_risk(scene, *apart(cars))[0])))(states)
        plain = jit_quickly(jax.vmap(derivative(lambda cars: plain_collision_risk(scene, *apart(cars)))))(states)
    plain = np.asarray(plain)
    assert abs(plain).max() > 0.1, "the cars should be close"
    np.testing.assert_allclose(ours, plain, rtol=1e-9, atol=1e-9 * abs(plain).max())


@pytest.mark.slow
@pytest.mark.parametrize("times", [(), (3,), (2, 3)])
def test_the_risk_takes_every_shape_of_times(played, times):
    game, state = played("stay_back")
    states = jnp.broadcast_to(state, (*times, *state.shape))
    own, others = apart(jnp.moveaxis(states, -2, 0))
    risk, collision = jit_quickly(collision_risk)(game.scene, own, others)
    assert risk.shape == collision.shape == times
    np.testing.assert_allclose(risk, jit_quickly(plain_collision_risk)(game.scene, own, others), rtol=1e-4)
