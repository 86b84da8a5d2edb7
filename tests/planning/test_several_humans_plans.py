"""Plans among several humans: assignments of models, far humans, their order, and numbers of steps."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.game import move, move_all, pair, swap_roles
from ms_highway.game.scenario import build_game
from ms_highway.game.scenarios import DENSE_MERGE
from ms_highway.game.starts import draw_episode
from ms_highway.numerics.solvers import PlanningSettings
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state, most_steps
from ms_highway.planning.human_models import TheoryOfMind, Turn
from ms_highway.planning.joint import Interaction as Situation
from ms_highway.planning.joint import mixed_bends
from ms_highway.planning.ladders import MODELS, ladder
from ms_highway.planning.plans import cold_start
from ms_highway.runtime.compilation import jit_quickly

FAR = 2000.0  # m
LADDER = ladder(["naive", "idm", "turn", "tom"])
NAIVE, IDM, TURN, TOM = range(len(LADDER))


@pytest.fixture(scope="module")
def three():
    """Dense Merge with three humans, whose rewards differ, and plans of half a second."""
    bounds = {"control_limit": DENSE_MERGE.control_limit, "grip": DENSE_MERGE.grip}
    game = build_game(DENSE_MERGE, humans=3, planning=PlanningSettings(horizon=5), **bounds)
    starts, weights = draw_episode(DENSE_MERGE, np.random.default_rng(0), game.humans)
    return replace(game, humans=replace(game.humans, weights=weights)), checked_state(starts)


@pytest.fixture(scope="module")
def plans(three):
    return CompiledPlans(three[0], LADDER)


def test_one_compilation_serves_all_assignments(three, plans):
    game, state = three
    plans.warm_up(state)
    function = plans.call(state, [NAIVE] * 3)[0]
    plans.plan(state, [NAIVE] * 3)  # whose numbers are placed
    sizes = function._cache_size()
    found = [plans.plan(state, np.random.default_rng(seed).integers(0, len(LADDER), 3))[0].robot for seed in range(5)]
    assert np.isfinite(found).all()
    assert abs(np.diff(found, axis=0)).max() > 1e-3
    bolder = CompiledPlans(replace(game, humans=replace(game.humans, weights=game.humans.weights * 1.1)), LADDER)
    again, _ = bolder.plan(state, [TOM] * 3, plans.plan(state, [TOM] * 3)[0])
    assert np.isfinite(again.robot).all()
    assert function is bolder.call(state, [TOM] * 3)[0]
    assert function._cache_size() == sizes


def test_mixed_second_derivatives_do_not_need_the_other_cars(three):
    game, state = three[0], jnp.asarray(three[1]).at[0, 1].set(-1.5)  # between the lanes
    start, who, changed = cold_start(game, state), Situation(game, state), []
    robot, humans = move(game, state[0], start.robot), move_all(game, state[1:4], start.humans)
    for human in range(3):
        own, around = swap_roles(game, human), who.around(human, robot, humans)
        wanted = own.payoff.second_order(humans[human], around).partner
        np.testing.assert_allclose(mixed_bends(own, humans[human], around), wanted, rtol=1e-3, atol=1e-4)
        changed.append(abs(wanted).max())
    assert max(changed) > 0.1


def test_each_human_is_predicted_in_the_game_of_the_robot_with_this_human_alone(three, plans):
    game, state = three
    expected = plans.plan(state, [TURN, IDM, NAIVE])[0].humans
    for human, model in enumerate((Turn(), MODELS["idm"], MODELS["naive"])):
        predicted = jit_quickly(model.predict)(*pair(game, jnp.asarray(state), human))
        np.testing.assert_allclose(predicted / game.planner.control_scale, expected[human], atol=1e-5)


@dataclass(frozen=True)
class Answering(TheoryOfMind):
    """Theory of mind by another name."""

    name: ClassVar[str] = "answering"


def test_a_user_defined_model_can_respond_to_the_robots_plan(three, plans):
    game, state = three
    expected = plans.plan(state, [TOM, NAIVE, TOM])[0]
    found = CompiledPlans(game, (MODELS["naive"], Answering())).plan(state, [1, 0, 1])[0]
    np.testing.assert_allclose(found.robot, expected.robot, atol=1e-4)
    np.testing.assert_allclose(found.humans, expected.humans, atol=1e-4)


def test_a_human_that_is_far_away_changes_nothing_under_any_model(three, plans):
    away = three[1].copy()
    away[3, 0] -= FAR
    expected, _ = plans.plan(away, [TOM, TURN, NAIVE])
    for rung in (IDM, TURN, TOM):
        plan, _ = plans.plan(away, [TOM, TURN, rung])
        np.testing.assert_allclose(plan.robot, expected.robot, atol=1e-5)
        np.testing.assert_allclose(plan.humans[:2], expected.humans[:2], atol=1e-5)


def test_the_order_of_humans_changes_nothing(three, plans):
    game, state = three
    rungs, order = np.array([TOM, TURN, NAIVE]), np.array([2, 0, 1])
    expected, _ = plans.plan(state, rungs)
    reordered = CompiledPlans(replace(game, humans=replace(game.humans, weights=game.humans.weights[order])), LADDER)
    plan, _ = reordered.plan(state[[0, *(1 + order)]], rungs[order])
    np.testing.assert_allclose(plan.robot, expected.robot, atol=1e-5)
    np.testing.assert_allclose(plan.humans, expected.humans[order], atol=1e-5)


@pytest.mark.parametrize(
    ("names", "rungs", "steps"),
    [
        ("naive tom", [1, 1, 0], None),
        ("naive tom@6", [1, 0, 0], (8, 6)),
        ("naive tom@2 tom", [1, 0, 1], (8, 2)),
        ("naive@2 naive@12 tom", [0, 1, 0], (12, 0)),  # nobody answers
    ],
)
def test_plans_take_the_largest_numbers_of_steps_that_rungs_in_use_ask_for(three, names, rungs, steps):
    found = most_steps(ladder(names.split()), three[0], np.array(rungs))
    assert (found and tuple(map(int, found))) == steps


def test_plans_start_from_zero_controls_or_up_a_smooth_reward_from_constant_velocity(three, plans):
    game, state = three
    start = cold_start(game, state)
    assert start.humans[2, 4] * game.planner.control_scale == pytest.approx([0.0, 0.2 * state[3, 3]], rel=1e-5)
    assert {type(part) for part in start} == {np.ndarray}  # computed by NumPy, as its time is not counted
    *_, begin = plans.call(state, [TOM] * 3)
    np.testing.assert_array_equal(begin.humans, start.humans)
    papers = replace(game, planner=replace(game.planner, smooth=False))
    assert not any(controls.any() for controls in cold_start(papers, state))
