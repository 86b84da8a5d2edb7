"""Plans among several humans: as with one human, far humans, all assignments in one compilation, measured times."""

from dataclasses import replace

import numpy as np
import pytest

from ms_highway.game.crowd import Crowd
from ms_highway.game.crowd_scenario import DENSE_MERGE, crowd_game, draw_crowd
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.planning.compiled_crowd import (
    CompiledCrowdPlans,
    crowd_plan_function,
    first_crowd_plan,
    human_plan_function,
    measure_crowd_costs,
)
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.crowd import NAIVE, TOM, TURN
from ms_highway.planning.human_models import MODELS, PAPER_MODELS
from ms_highway.runtime.packing import pack

FAR = 2000.0  # m


@pytest.fixture(scope="module")
def six():
    """Dense Merge with six humans, whose rewards differ, and plans of half a second."""
    starts, weights = draw_crowd(DENSE_MERGE, 6, np.random.default_rng(0))
    return crowd_game(DENSE_MERGE, 6, weights, planning=PlanningSettings(horizon=5)), checked_state(starts)


@pytest.mark.parametrize(
    ("scenario", "semantics"),
    [
        ("merger", "paper"),
        pytest.param("stay_back", "paper", marks=pytest.mark.slow),
        pytest.param("give_way", "released", marks=pytest.mark.slow),
    ],
)
def test_with_one_human_plans_are_those_of_the_game_of_two(played, scenario, semantics):
    game, state = played(scenario, semantics=semantics)
    state = checked_state(np.asarray(state))
    crowd, usual = CompiledCrowdPlans(Crowd(game, np.asarray(game.human.weights)[None])), CompiledPlans(game)
    for rung, name in enumerate(PAPER_MODELS):
        expected, _ = usual.plan(MODELS[name], state)
        plan, _ = crowd.plan(state, [rung])
        np.testing.assert_allclose(plan.robot, expected.robot, atol=1e-5)
        np.testing.assert_allclose(plan.humans[0], expected.human, atol=1e-5)
    np.testing.assert_allclose(crowd.predict(state, 0)[0], usual.plan(MODELS["turn"], state)[0].human, atol=1e-5)


def test_one_compilation_serves_all_assignments_and_all_humans(six):
    crowd, state = six
    plans = CompiledCrowdPlans(crowd)
    plans.warm_up(state)
    plans.warm_up_humans(state)
    functions = [each(pack(crowd).layout) for each in (crowd_plan_function, human_plan_function)]
    sizes = [function._cache_size() for function in functions]
    random = np.random.default_rng(0)
    found = [plans.plan(state, random.integers(0, 3, 6))[0].robot for _ in range(5)]
    assert np.isfinite(found).all()
    assert abs(np.diff(found, axis=0)).max() > 1e-3
    predictions = np.array([plans.predict(state, human)[0] for human in range(6)])
    np.testing.assert_allclose(plans.plan(state, [TURN] * 6)[0].humans, predictions, atol=1e-6)
    dearer = CompiledCrowdPlans(replace(crowd, weights=np.asarray(crowd.weights) * 1.1))
    again, _ = dearer.plan(state, [TOM] * 6, plans.plan(state, [TOM] * 6)[0])
    assert np.isfinite(again.robot).all()
    assert [function._cache_size() for function in functions] == sizes


def test_a_human_that_is_far_away_changes_nothing_under_any_model(six):
    crowd, state = six
    away = state.copy()
    away[6, 0] -= FAR
    plans = CompiledCrowdPlans(crowd)
    rungs = [TOM, TURN, NAIVE, TOM, NAIVE]
    expected, _ = plans.plan(away, [*rungs, NAIVE])
    for rung in (TURN, TOM):
        plan, _ = plans.plan(away, [*rungs, rung])
        np.testing.assert_allclose(plan.robot, expected.robot, atol=1e-5)
        np.testing.assert_allclose(plan.humans[:5], expected.humans[:5], atol=1e-5)
    near, _ = plans.plan(state, [*rungs, TOM])
    assert np.isfinite(near.robot).all()


def test_the_order_of_humans_changes_nothing(six):
    crowd, state = six
    rungs, order = np.array([TOM, TURN, NAIVE, TOM, NAIVE, TURN]), np.array([3, 5, 0, 1, 4, 2])
    plans = CompiledCrowdPlans(crowd)
    expected, _ = plans.plan(state, rungs)
    reordered = CompiledCrowdPlans(replace(crowd, weights=crowd.weights[order]))
    plan, _ = reordered.plan(state[[0, *(1 + order)]], rungs[order])
    np.testing.assert_allclose(plan.robot, expected.robot, atol=1e-5)
    np.testing.assert_allclose(plan.humans, expected.humans[order], atol=1e-5)


def test_plans_start_from_zero_controls_or_from_keeping_the_velocity(six):
    crowd, state = six
    kept = np.asarray(first_crowd_plan(crowd, state).humans[2, 4]) * crowd.game.planner.control_scale
    assert kept == pytest.approx([0.0, 0.2 * state[3, 3]], rel=1e-5)
    papers = replace(crowd.game, planner=replace(crowd.game.planner, solver="gradient"))
    assert not np.concatenate([each.ravel() for each in first_crowd_plan(replace(crowd, game=papers), state)]).any()


def test_measured_times_are_additive_and_grow_up_the_ladder(six):
    crowd, state = six
    costs = measure_crowd_costs(crowd, state, repeats=9, quantile=0.0)
    assert costs.base > 0
    assert costs.each[NAIVE] == 0
    assert costs.each[TOM] > 0
    plans = CompiledCrowdPlans(crowd)
    seconds = min(plans.plan(state, [TOM] * 3 + [NAIVE] * 3)[1] for _ in range(9))
    assert costs.base < seconds < costs.base + 6 * costs.each[TOM]
