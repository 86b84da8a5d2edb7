"""Properties of the dynamics that hold for all states and controls."""

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as draw

from ms_highway.game.dynamics import Dynamics, observe, recover_control, rollout, step

PAPER = Dynamics("curvature", "linear", 0.2, 0.1)
RELEASED_PLAN = Dynamics("yaw_rate", "linear", 0.0, 0.1)
RELEASED_WORLD = Dynamics("yaw_rate", "quadratic", 0.006, 0.1)

with_rollouts = draw.sampled_from([PAPER, RELEASED_PLAN])
any_dynamics = draw.sampled_from([PAPER, RELEASED_PLAN, RELEASED_WORLD])
places = draw.floats(-1000.0, 1000.0)
headings = draw.floats(-3.0, 3.0)
speeds = draw.floats(5.0, 40.0)
moving = draw.tuples(places, places, headings, speeds).map(np.array)
controls = draw.tuples(draw.floats(-0.1, 0.1), draw.floats(-8.0, 8.0)).map(np.array)
plans = draw.lists(controls, min_size=4, max_size=4).map(np.array)

step_in_jax = jax.jit(step)
rollout_in_jax = jax.jit(rollout)


@given(any_dynamics, moving, controls, draw.integers(-2, 2))
def test_the_recovered_control_of_a_step_is_its_control(dynamics, car, control, turns):
    after = step(dynamics, car, control)
    assert after.dtype == np.float64
    after[2] += turns * 2 * np.pi
    found = recover_control(dynamics, car, after)
    np.testing.assert_allclose(found, control, atol=1e-9)


@given(any_dynamics, draw.lists(moving, min_size=6, max_size=6), controls)
def test_many_cars_move_as_each_of_them_does(dynamics, cars, control):
    cars = np.stack(cars).reshape(2, 3, 4)
    many = np.broadcast_to(control, (2, 3, 2))
    after = step(dynamics, cars, many)
    for place in np.ndindex(2, 3):
        alone = step(dynamics, cars[place], control)
        np.testing.assert_allclose(after[place], alone, rtol=1e-12, atol=1e-12)
    found = recover_control(dynamics, cars, after)
    np.testing.assert_allclose(found, many, atol=1e-9)


@given(any_dynamics, places, places, headings)
def test_a_standing_car_has_no_observable_curvature(dynamics, x, y, heading):
    car = np.array([x, y, heading, 0.0])
    assert not recover_control(dynamics, car, car).any()


@given(any_dynamics, moving, controls)
def test_a_step_is_the_same_in_numpy_and_in_jax(dynamics, car, control):
    in_jax = step_in_jax(dynamics, np.float32(car), np.float32(control))
    in_numpy = step(dynamics, car, control)
    np.testing.assert_allclose(in_jax, in_numpy, rtol=1e-5, atol=1e-5)


@given(with_rollouts, moving, plans)
def test_a_rollout_equals_repeated_steps(dynamics, car, plan):
    after = [car]
    for control in plan:
        after.append(step(dynamics, after[-1], control))
    motion = rollout_in_jax(dynamics, np.float32(car), np.float32(plan))
    expected = observe(np.stack(after[1:]))
    for found, field in zip(motion, expected, strict=True):
        np.testing.assert_allclose(found, field, rtol=1e-5, atol=1e-4)
