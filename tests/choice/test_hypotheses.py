"""The next control of every human under each model."""

import numpy as np
import pytest

from ms_highway.choice.belief import next_controls
from ms_highway.game.game import swap_roles
from ms_highway.loop.driver import fixed
from ms_highway.numerics.solvers import PlanningSettings
from ms_highway.planning.ladders import PACKAGE_MODELS
from ms_highway.runtime.compilation import jit_quickly

NUMBERS = {name: number for number, name in enumerate(PACKAGE_MODELS)}
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
    np.testing.assert_allclose(controls[NUMBERS["turn"]], human.control, atol=0.01)
    friction = [0.0, 0.2 * cars[1, 3]]
    np.testing.assert_allclose(controls[NUMBERS["naive"]], friction, rtol=1e-4)


def test_idm_brakes_for_a_robot_in_its_lane(merger):
    game, cars = merger
    in_lane = cars.copy()
    in_lane[0, :2] = cars[1, :2] + [6.0, 0.0]

    # Accelerations of the only human under each model.
    beside = predicted(game, cars, STRAIGHT)[0, :, 1]
    ahead = predicted(game, in_lane, STRAIGHT)[0, :, 1]
    assert ahead[NUMBERS["idm"]] < beside[NUMBERS["idm"]] - 1.0
    assert ahead[NUMBERS["naive"]] == beside[NUMBERS["naive"]]


def test_only_theory_of_mind_answers_the_robots_plan(merger):
    (straight,) = predicted(*merger, STRAIGHT)
    (cuts_in,) = predicted(*merger, CUTTING_IN)
    tom = NUMBERS["tom"]  # the last model
    np.testing.assert_array_equal(straight[:tom], cuts_in[:tom])
    assert cuts_in[tom, 1] < straight[tom, 1] - 1.0


def test_long_steps_do_not_overshoot(played):
    game, state = played("merger", planning=PlanningSettings(horizon=10, time_step=0.2))
    (controls,) = predicted(game, state, np.tile(STRAIGHT[:1], (10, 1)))
    # Steps that overshoot reach the limits, at 5 m/s^2 and more.
    accelerations = controls[:, 1]
    assert abs(accelerations - accelerations[NUMBERS["naive"]]).max() < 5.0
