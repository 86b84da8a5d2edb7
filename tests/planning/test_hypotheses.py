"""The next control of every human under each model."""

import jax
import numpy as np
import pytest

from ms_highway.choice.belief import next_controls
from ms_highway.game.game import swap_roles
from ms_highway.loop.driver import fixed
from ms_highway.numerics.solvers import PlanningSettings

NAIVE, IDM, TURN, TOM = range(4)
STRAIGHT = np.tile(np.float32([0.0, 0.12]), (5, 1))  # keeps 20 m/s
CUTTING_IN = STRAIGHT + np.float32([-0.3, 0.0])


@pytest.fixture
def predicted(played):
    game, state = played("merger")

    def predict(plan, robot=None):
        cars = np.array(state)
        cars[0, :2] = cars[0, :2] if robot is None else robot
        return np.asarray(jax.jit(next_controls)(game, cars, plan))[0], cars, game

    return predict


def test_turn_predicts_humans_of_this_package_and_naive_compensates_friction(predicted):
    controls, cars, game = predicted(STRAIGHT)
    human = fixed(swap_roles(game)).step(cars[[1, 0, *range(2, len(cars))]])
    np.testing.assert_allclose(controls[TURN], human.control, atol=0.01)
    np.testing.assert_allclose(controls[NAIVE], [0.0, 0.2 * cars[1, 3]], rtol=1e-4)


def test_idm_brakes_for_the_robot_once_it_is_in_its_lane(predicted):
    beside, cars, _ = predicted(STRAIGHT)
    x, y = cars[1, :2]
    ahead, *_ = predicted(STRAIGHT, robot=(x + 6.0, y))
    assert ahead[IDM, 1] < beside[IDM, 1] - 1.0
    assert ahead[NAIVE, 1] == beside[NAIVE, 1]


def test_theory_of_mind_answers_the_robots_plan_and_turn_does_not(predicted):
    straight, cuts_in = (predicted(plan)[0] for plan in (STRAIGHT, CUTTING_IN))
    np.testing.assert_array_equal(straight[:TOM], cuts_in[:TOM])
    assert cuts_in[TOM, 1] < straight[TOM, 1] - 1.0


def test_long_steps_do_not_overshoot(played):
    game, state = played("merger", planning=PlanningSettings(horizon=10, time_step=0.2))
    plan = np.tile(STRAIGHT[:1], (10, 1))
    controls = np.asarray(jax.jit(next_controls)(game, state, plan))[0]
    assert np.abs(controls[:, 1] - controls[NAIVE, 1]).max() < 5.0  # m/s^2; limits are reached by steps that overshoot
