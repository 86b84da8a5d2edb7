"""Motion: one step, several steps, and the control between two states."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import (
    Dynamics,
    coast,
    keep_velocity,
    observe,
    recover_control,
    rollout,
    step,
    within_grip,
)

PAPER = Dynamics("curvature", "linear", 0.2, 0.1)
RELEASED_PLAN = Dynamics("yaw_rate", "linear", 0.0, 0.1)
RELEASED_WORLD = Dynamics("yaw_rate", "quadratic", 0.006, 0.1)
ALL = pytest.mark.parametrize("dynamics", [PAPER, RELEASED_PLAN, RELEASED_WORLD])
compiled = jax.jit(rollout)
BATCHES = pytest.mark.parametrize("batch", [(), (2, 1)])


def drawn(batch, seed=0):
    random = np.random.default_rng(seed)
    states = random.normal([0, 0, 0, 20], [30, 3, 0.3, 4], (*batch, 4))
    return states, random.normal(0, [0.05, 3], (*batch, 2))


def test_a_step_of_the_bicycle_is_the_papers_equation():
    x, y, heading, speed = step(PAPER, np.array([1.0, 2.0, 0.3, 20.0]), np.array([0.01, 5.0]))
    acceleration = 5.0 - 0.2 * 20.0
    distance = 20.0 * 0.1 + acceleration * 0.1**2 / 2
    assert x == pytest.approx(1 + distance * np.cos(0.3))
    assert y == pytest.approx(2 + distance * np.sin(0.3))
    assert heading == pytest.approx(0.3 + 20.0 * 0.01 * 0.1)
    assert speed == pytest.approx(20 + acceleration * 0.1)


@ALL
@BATCHES
def test_recovering_a_control_inverts_a_step_in_every_batch_shape(dynamics, batch):
    states, controls = drawn(batch)
    after = step(dynamics, states, controls)
    assert isinstance(after, np.ndarray)
    assert after.dtype == np.float64
    np.testing.assert_allclose(recover_control(dynamics, states, after), controls, atol=1e-9)
    np.testing.assert_allclose(step(dynamics, states, recover_control(dynamics, states, after)), after, atol=1e-9)


def test_a_standing_car_has_no_observable_curvature():
    standing = np.array([0.0, 0.0, 0.1, 0.0])
    np.testing.assert_array_equal(recover_control(PAPER, standing, standing), [0.0, 0.0])


@pytest.mark.parametrize("dynamics", [PAPER, RELEASED_PLAN])
@BATCHES
def test_a_rollout_equals_repeated_steps(dynamics, batch):
    state, _ = drawn(batch)
    controls = np.stack([drawn(batch, seed)[1] for seed in range(5)])
    states = [state]
    for control in controls:
        states.append(step(dynamics, states[-1], control))
    rolled = compiled(dynamics, jnp.asarray(state), jnp.moveaxis(jnp.asarray(controls), 0, -2))
    for field, expected in zip(rolled, observe(np.stack(states[1:], axis=-2)), strict=True):
        assert field.shape == (*batch, 5)
        np.testing.assert_allclose(field, expected, rtol=1e-5, atol=1e-4)


@ALL
@BATCHES
def test_a_car_that_keeps_its_velocity_coasts(dynamics, batch):
    state, _ = drawn(batch)
    moved = state
    for _ in range(4):
        moved = step(dynamics, moved, keep_velocity(dynamics, moved))
    np.testing.assert_allclose(moved[..., 2:], state[..., 2:], atol=1e-9)
    for field, expected in zip(coast(dynamics, jnp.asarray(state), 4), observe(moved), strict=True):
        assert field.shape == (*batch, 4)
        np.testing.assert_allclose(field[..., -1], expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("dynamics", [PAPER, RELEASED_PLAN])
def test_controls_within_the_grip_are_kept_and_others_scaled_onto_the_friction_circle(dynamics):
    random = np.random.default_rng(0)
    speed, control = random.uniform(0, 30, 500), random.normal(0, [0.05, 8], (500, 2))
    bend = 0.02
    held = within_grip(dynamics, 8.0, speed, control, bend)
    after = step(dynamics, speed[:, None] * [0.0, 0.0, 0.0, 1.0], held)
    turned = after[:, 2] / dynamics.time_step * speed + bend * speed**2  # m/s^2 to the side, the road's bend included
    total = np.hypot(turned, (after[:, 3] - speed) / dynamics.time_step)
    assert total.max() <= 8.0 + 1e-6
    assert after[:, 3].min() >= -1e-12
    free = np.isclose(held, control, atol=1e-12).all(axis=1)
    assert 0.1 < free.mean() < 0.9
    stops = np.isclose(after[:, 3], 0, atol=1e-9)
    np.testing.assert_allclose(total[~free & ~stops], 8.0)


def test_a_car_that_rolls_backwards_is_stopped():
    held = within_grip(PAPER, 8.0, np.array(-0.3), np.array([0.0, -5.0]))
    assert step(PAPER, np.array([0.0, 0.0, 0.0, -0.3]), held)[3] == pytest.approx(0.0)


def test_a_rollout_refuses_quadratic_friction():
    with pytest.raises(ValueError, match="linear friction"):
        rollout(RELEASED_WORLD, jnp.zeros(4), jnp.zeros((5, 2)))
