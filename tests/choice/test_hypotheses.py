"""The next control of every human under each model."""

import numpy as np
import pytest

from ms_highway.choice.belief import next_controls
from ms_highway.game.game import swap_roles
from ms_highway.loop.driver import fixed
from ms_highway.numerics.solvers import PlanningSettings
from ms_highway.runtime.compilation import jit_quickly

NAIVE, IDM, TURN, TOM = range(4)
STRAIGHT = np.tile(np.float32([0.0, 0.12]), (5, 1))  # keeps 20 m/s
CUTTING_IN = STRAIGHT + np.float32([-0.3, 0.0])

predicted = jit_quickly(next_controls)


@pytest.fixture
def merger(played):
    game, state = played("merger")
    return game, np.array(state)


def test_turn_predicts_humans_of_this_package_and_naive_compensates_friction(merger):
    game, cars = merger
    (controls,) = predicted(game, cars, STRAIGHT)
    human = fixed(swap_roles(game)).step(cars[[1, 0, *range(2, len(cars))]])
    np.testing.assert_allclose(controls[TURN], human.control, atol=0.01)
    np.testing.assert_allclose(controls[NAIVE], [0.0, 0.2 * cars[1, 3]], rtol=1e-4)


def test_idm_brakes_for_the_robot_once_it_is_in_its_lane(merger):
    game, cars = merger
    (beside,) = predicted(game, cars, STRAIGHT)
    in_lane = cars.copy()  # JAX may still read the other array
    in_lane[0, :2] = cars[1, :2] + [6.0, 0.0]
    (ahead,) = predicted(game, in_lane, STRAIGHT)
    assert ahead[IDM, 1] < beside[IDM, 1] - 1.0
    assert ahead[NAIVE, 1] == beside[NAIVE, 1]


def test_theory_of_mind_answers_the_robots_plan_and_turn_does_not(merger):
    (straight,), (cuts_in,) = (
        predicted(*merger, plan) for plan in (STRAIGHT, CUTTING_IN)
    )
    np.testing.assert_array_equal(straight[:TOM], cuts_in[:TOM])
    assert cuts_in[TOM, 1] < straight[TOM, 1] - 1.0


def test_long_steps_do_not_overshoot(played):
    game, state = played("merger", planning=PlanningSettings(horizon=10, time_step=0.2))
    (controls,) = predicted(game, state, np.tile(STRAIGHT[:1], (10, 1)))
    assert (
        abs(controls[:, 1] - controls[NAIVE, 1]).max() < 5.0
    )  # m/s^2; limits are reached by steps that overshoot
