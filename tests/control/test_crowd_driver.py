"""Drivers among several humans: what they record, how they decide, and what they do when a plan fails or is late."""

from dataclasses import replace

import numpy as np
import pytest
from ms_highway.control.crowd import CrowdDriver, HumanDriver
from ms_highway.control.fixed import FixedModel
from ms_highway.game.crowd import Crowd
from ms_highway.metareasoning.crowd.baselines import AllOfOne, Nearest
from ms_highway.metareasoning.crowd.compiled_decision import crowd_decision_function
from ms_highway.planning.compiled_crowd import crowd_plan_function
from ms_highway.planning.crowd import NAIVE, TOM

from ms_highway.planning.human_models import MODELS


@pytest.fixture
def crowd(played):
    """Merger with a second human, 30 m behind the first."""
    game, state = played("merger")
    state = np.asarray(state)
    follower = state[1] - [30.0, 0.0, 0.0, 0.0]
    return Crowd(game, np.tile(game.human.weights, (2, 1))), np.concatenate([state[:2], [follower], state[2:]])


def test_a_step_tells_what_was_planned_for_every_human(crowd):
    crowd, state = crowd
    step = CrowdDriver(crowd, Nearest(1)).step(state)
    assert step.rungs == ("tom", "naive")
    assert step.model == "tom"
    assert step.status == "planned"
    assert step.plan.shape == (5, 2)
    assert step.humans.shape == (2, 5, 2)
    np.testing.assert_array_equal(step.human, step.humans[0])
    np.testing.assert_array_equal(step.control, step.plan[0])
    assert step.humans[1, 0] == pytest.approx([0.0, 0.2 * state[2, 3]], rel=1e-4)  # only makes up for friction
    assert 0 < step.planning_seconds < 1
    assert 0 < step.decision_seconds < 1
    assert step.gains == {}


def test_nothing_compiles_after_the_first_step(crowd):
    crowd, state = crowd
    driver = CrowdDriver(crowd, Nearest(0))
    driver.step(state)
    compiled = [function.cache_info().currsize for function in (crowd_plan_function, crowd_decision_function)]
    heavier = replace(crowd, weights=np.asarray(crowd.weights) * 1.5)
    for count in range(3):
        driver = CrowdDriver(heavier, Nearest(count))
        assert driver.step(state).compile_seconds == 0
        driver.crowd = crowd
        assert driver.step(state).compile_seconds == 0
    assert compiled == [function.cache_info().currsize for function in (crowd_plan_function, crowd_decision_function)]


def test_plans_that_fail_fall_back_to_the_rest_of_the_last_one_and_then_brake(crowd):
    crowd, state = crowd
    driver = CrowdDriver(crowd, AllOfOne(NAIVE))
    first = driver.step(state)
    driver.game = replace(crowd.game, robot=replace(crowd.game.robot, weights=crowd.game.robot.weights * np.nan))
    steps = [driver.step(state) for _ in range(6)]
    assert [step.status for step in steps] == ["previous plan"] * 4 + ["braking"] * 2
    np.testing.assert_allclose(steps[0].plan, first.plan[1:], rtol=1e-6)
    np.testing.assert_allclose(steps[3].control, first.plan[4], rtol=1e-6)
    np.testing.assert_allclose(steps[4].control, [0.0, -8.0], atol=0.01)


def test_a_plan_that_is_late_is_followed_from_the_next_step_on(crowd):
    crowd, state = crowd
    driver, punctual = CrowdDriver(crowd, AllOfOne(TOM), budget=0.0), CrowdDriver(crowd, AllOfOne(TOM))
    first, second = driver.step(state), driver.step(state)
    planned = [punctual.step(state), punctual.step(state)]
    assert [first.status, second.status] == ["late", "late"]
    assert first.control[1] < 0  # brakes, as there is no plan yet
    np.testing.assert_allclose(second.plan, planned[0].plan[1:], rtol=1e-6)
    driver.budget = None
    third = driver.step(state)
    assert third.status == "planned"
    np.testing.assert_allclose(third.plan, punctual.step(state).plan, rtol=1e-6)


def test_humans_drive_by_their_own_rewards(crowd):
    crowd, state = crowd
    others = [0, 1, *range(3, len(state))]
    step = HumanDriver(crowd, 1).step(state[[2, *others]])
    assert step.status == "planned"
    mirrored = replace(crowd.game, robot=crowd.game.human, human=crowd.game.robot)
    expected = FixedModel(mirrored, MODELS["naive"]).step(state[[2, *others]])
    np.testing.assert_allclose(step.plan, expected.plan, atol=1e-4)
    np.testing.assert_allclose(step.human, expected.human, rtol=1e-5)
