"""Plans among several humans: assignments of models, far humans, order and steps."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from driving import Brakes

from ms_highway.game.game import move, move_all, pair, swap_roles
from ms_highway.numerics.solvers import Ascent
from ms_highway.planning.compiled_plans import (
    CompiledPlans,
    assigned_responders,
    checked_state,
)
from ms_highway.planning.influence import mixed_hessian, trajectories_around
from ms_highway.planning.ladders import PACKAGE_MODELS, ladder
from ms_highway.planning.plans import cold_start
from ms_highway.runtime.compilation import jit_quickly

LADDER = (*ladder(PACKAGE_MODELS), Brakes(3.0))
NAIVE, IDM, TURN, TOM, BRAKES = range(len(LADDER))


def with_weights(game, weights):
    """The game of humans with other weights."""
    humans = replace(game.humans, weights=weights)
    return replace(game, humans=humans)


@pytest.fixture(scope="module")
def three(played):
    """Dense Merge with three humans whose rewards differ; plans of half a second."""
    game, state = played("dense_merge", humans=3)
    weights = game.humans.weights * np.float32([[1.0], [1.5], [0.5]])
    return with_weights(game, weights), checked_state(state)


@pytest.fixture(scope="module")
def plans(three):
    return CompiledPlans(three[0], LADDER)


def close(found, expected):
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_one_compilation_serves_all_assignments(three, plans):
    game, state = three
    plans.warm_up(state)
    function, *_ = plans.call(state, [NAIVE] * 3)
    plans.plan(state, [NAIVE] * 3)  # whose numbers are placed
    sizes = function._cache_size()

    # Assignments that are drawn by chance.
    found = []
    for seed in range(5):
        rungs = np.random.default_rng(seed).integers(0, len(LADDER), 3)
        solution, _ = plans.plan(state, rungs)
        found.append(solution.plan.robot)
    assert np.isfinite(found).all()
    assert abs(np.diff(found, axis=0)).max() > 1e-3

    # A game with other weights, and a start.
    bolder_game = with_weights(game, game.humans.weights * 1.1)
    bolder = CompiledPlans(bolder_game, LADDER)
    first, _ = plans.plan(state, [TOM] * 3)
    again, _ = bolder.plan(state, [TOM] * 3, first.plan)
    assert np.isfinite(again.plan.robot).all()
    assert function is bolder.call(state, [TOM] * 3)[0]
    assert function._cache_size() == sizes


def test_mixed_second_derivatives_do_not_need_the_other_cars(three):
    game = three[0]
    state = three[1].copy()
    state[0, 1] = -1.5  # between the lanes

    @jax.jit
    @jax.vmap
    def with_and_without(human):
        start = cold_start(game, state)
        robot = move(game, state[0], start.robot)
        humans = move_all(game, state[1:4], start.humans)
        own = swap_roles(game, human)
        around = trajectories_around(human, robot, humans)
        with_others = own.payoff.second_order(humans[human], around).mixed_hessian
        return with_others, mixed_hessian(own, humans[human], around)

    wanted, found = with_and_without(np.arange(3))
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4)
    assert np.abs(wanted).max() > 0.1


def test_each_human_is_predicted_with_the_robot_alone(three, plans):
    game, state = three
    rungs = [TURN, IDM, BRAKES]
    scale = game.planner.control_scale
    found = plans.plan(state, rungs)[0].plan.humans
    for human, rung in enumerate(rungs[:2]):
        predict = jit_quickly(LADDER[rung].predict)
        close(found[human], predict(*pair(game, state, human)) / scale)
    close(found[2, :, 1], (0.2 * state[3, 3] - 3.0) / scale[1])  # predicted in SI units


def test_a_far_human_changes_nothing_under_any_model(three, plans):
    away = three[1].copy()
    away[3, 0] -= 2000.0
    expected = plans.plan(away, [TOM, TURN, NAIVE])[0].plan
    for rung in (IDM, TURN, TOM):
        plan = plans.plan(away, [TOM, TURN, rung])[0].plan
        close(plan.robot, expected.robot)
        close(plan.humans[:2], expected.humans[:2])


def test_the_order_of_humans_changes_nothing(three, plans):
    game, state = three
    rungs = np.array([TOM, TURN, NAIVE])
    order = np.array([2, 0, 1])
    expected, _ = plans.plan(state, rungs)

    reordered_game = with_weights(game, game.humans.weights[order])
    reordered = CompiledPlans(reordered_game, LADDER)
    reordered_state = state[[0, *(1 + order)]]
    found, _ = reordered.plan(reordered_state, rungs[order])
    close(found.plan.robot, expected.plan.robot)
    close(found.plan.humans, expected.plan.humans[order])


@pytest.mark.parametrize(
    ("names", "rungs", "steps", "robot_steps"),
    [
        ("naive tom", [1, 1, 0], [4, 4, 0], 4),
        ("naive tom@2 tom", [1, 0, 2], [2, 0, 4], 4),
        ("naive@2 naive@12 tom", [0, 1, 0], [0, 0, 0], 12),  # nobody responds
    ],
)
def test_each_human_responds_in_the_steps_of_its_own_model(
    three, names, rungs, steps, robot_steps
):
    found = assigned_responders(ladder(names.split()), three[0], np.array(rungs))
    assert found.steps.tolist() == steps
    assert found.robot_steps == robot_steps


def test_plans_up_a_smooth_reward_start_from_constant_velocity(three, plans):
    game, state = three
    start = cold_start(game, state)
    last_control = start.humans[2, 4] * game.planner.control_scale
    assert last_control == pytest.approx([0.0, 0.2 * state[3, 3]], rel=1e-5)
    # Computed by NumPy, as its time is not counted.
    assert {type(part) for part in start} == {np.ndarray}
    *_, begin = plans.call(state, [TOM] * 3)
    np.testing.assert_array_equal(begin.humans, start.humans)
    # Those up the paper's reward start from zero.
    papers = replace(game, planner=replace(game.planner, solver=Ascent()))
    assert not any(controls.any() for controls in cold_start(papers, state))
