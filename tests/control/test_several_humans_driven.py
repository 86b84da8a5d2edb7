"""Drivers among several humans: what they record, how they decide, and what they do when a plan fails or is late."""

from dataclasses import replace

import numpy as np
import pytest
from driving import move

from ms_highway.control.driver import Driver, fixed
from ms_highway.metareasoning.nearest import Nearest
from ms_highway.metareasoning.rule import always
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import MODELS, ladder

RUNGS = ladder(("naive", "turn", "tom"))
COSTS = Costs(0.09, np.array([0.0, 0.08, 0.28]))


def nearest(count):
    return Nearest(count, COSTS, RUNGS)


@pytest.fixture
def two(played):
    """Merger with a second human, 30 m behind the first."""
    game, state = played("merger", humans=2)
    return game, np.asarray(state)


def test_a_step_tells_what_was_planned_for_every_human(two):
    game, state = two
    step = Driver(game, nearest(1)).step(state)
    assert step.models == ("tom", "naive")
    assert step.status == "planned"
    assert step.plan.shape == (5, 2)
    assert step.humans.shape == (2, 5, 2)
    np.testing.assert_array_equal(step.control, step.plan[0])
    assert step.humans[1, 0] == pytest.approx([0.0, 0.2 * state[2, 3]], rel=1e-4)  # only makes up for friction
    assert 0 < step.planning_seconds < 1
    assert 0 < step.decision_seconds < 1
    assert np.isnan(step.gains).all()


def test_an_escape_is_followed_where_the_next_plan_fails_and_plans_go_on_from_the_one_that_it_replaced(played):
    """A human comes from behind, faster than the robot; another one is beside it."""
    game, state = played("dense_merge")
    game = replace(game, planner=replace(game.planner, newton_steps=1))  # so that it matters where plans start from
    lane, x = float(game.scene.target_lane), float(state[0, 0])
    start = np.array([state[0], [x - 12.0, state[0, 1], 0.0, 30.0], [x, lane, 0.0, 20.0], *state[3:]])
    driver, failing = (Driver(game, always(MODELS["naive"]), way_out=True) for _ in range(2))
    _, step = (each.step(start) for each in (driver, failing))
    assert step.status == "way out"
    np.testing.assert_array_equal(step.control, step.plan[0])
    now = move(game, start, [step.control, *(human[0] for human in step.humans)])
    failing.game = replace(game, robot=replace(game.robot, weights=game.robot.weights * np.nan))
    fallback = failing.step(now)
    assert fallback.status == "previous plan"
    np.testing.assert_array_equal(fallback.plan, step.plan[1:])
    driver.way_out, bold = False, fixed(game)
    assert bold.step(start).status == "planned"
    goes_on = driver.step(now).plan
    np.testing.assert_array_equal(goes_on, bold.step(now).plan)
    assert np.abs(goes_on - fixed(game).step(now).plan).max() > 1e-3
