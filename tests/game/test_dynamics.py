"""Motion: one step, several steps, and grip.

`tests/properties/test_motion.py` holds what is true of all states and controls.
"""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import (
    Dynamics,
    coast,
    keep_velocity,
    observe,
    rollout,
    rollout_jacobian,
    step,
    within_grip,
)

PAPER = Dynamics("curvature", "linear", 0.2, 0.1)
RELEASED_PLAN = Dynamics("yaw_rate", "linear", 0.0, 0.1)
RELEASED_WORLD = Dynamics("yaw_rate", "quadratic", 0.006, 0.1)
ALL = pytest.mark.parametrize("dynamics", [PAPER, RELEASED_PLAN, RELEASED_WORLD])
PLANS = pytest.mark.parametrize("dynamics", [PAPER, RELEASED_PLAN])
STATES = np.random.default_rng(0).normal([0, 0, 0, 20], [30, 3, 0.3, 4], (2, 3, 4))
CONTROLS = np.random.default_rng(1).normal(0, [0.05, 3], (5, 2, 3, 2))


@jax.jit
def derivatives(dynamics, car, controls):
    found = rollout_jacobian(dynamics, car, controls)
    return found, jnp.stack(jax.jacfwd(rollout, argnums=2)(dynamics, car, controls))


def test_a_step_of_the_bicycle_is_the_papers_equation():
    acceleration = 5.0 - 0.2 * 20.0
    distance = 20.0 * 0.1 + acceleration * 0.1**2 / 2
    moved = [
        distance * np.cos(0.3),
        distance * np.sin(0.3),
        20.0 * 0.01 * 0.1,
        acceleration * 0.1,
    ]
    state = np.array([1.0, 2.0, 0.3, 20.0])
    np.testing.assert_allclose(step(PAPER, state, np.array([0.01, 5.0])), state + moved)


@PLANS
def test_the_derivative_of_a_rollout_is_exact(dynamics):
    controls = np.moveaxis(CONTROLS, 0, -2)
    found, expected = derivatives(dynamics, STATES[0, 0], controls[0, 0])
    np.testing.assert_allclose(
        found, expected.reshape(found.shape), rtol=1e-4, atol=1e-4
    )


@ALL
def test_a_car_that_keeps_its_velocity_coasts(dynamics):
    moved = STATES
    for _ in range(4):
        moved = step(dynamics, moved, keep_velocity(dynamics, moved))
    np.testing.assert_allclose(moved[..., 2:], STATES[..., 2:], atol=1e-9)
    for field, expected in zip(coast(dynamics, STATES, 4), observe(moved), strict=True):
        np.testing.assert_allclose(field[..., -1], expected, rtol=1e-5, atol=1e-4)


@PLANS
def test_controls_are_scaled_onto_the_friction_circle_if_beyond_it(dynamics):
    """A car that rolls backwards stops."""
    random = np.random.default_rng(0)
    speed = random.uniform(-0.5, 30, 500)
    control = random.normal(0, [0.05, 8], (500, 2))
    bend = 0.02
    held = within_grip(dynamics, 8.0, speed, control, bend)
    after = step(dynamics, speed[:, None] * [0.0, 0.0, 0.0, 1.0], held)

    # Accelerations to the side, the road's bend included, and along the road.
    sideways = after[:, 2] / dynamics.time_step * speed + bend * speed**2
    along = (after[:, 3] - speed) / dynamics.time_step
    total = np.hypot(sideways, along)
    assert total.max() <= 8.0 + 1e-6
    assert after[:, 3].min() >= -1e-12
    free = np.isclose(held, control, atol=1e-12).all(axis=1)
    assert 0.1 < free.mean() < 0.9
    stops = np.isclose(after[:, 3], 0, atol=1e-9)
    np.testing.assert_allclose(total[~free & ~stops], 8.0)


def test_a_rollout_refuses_quadratic_friction():
    with pytest.raises(ValueError, match="linear friction"):
        rollout(RELEASED_WORLD, STATES, CONTROLS)
