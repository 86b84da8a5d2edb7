"""Controllers: records, clocks, fallbacks and compilations."""

from dataclasses import replace

import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.controller import FixedModel, ModelSwitching, _decide, compiled_plan, measure_costs
from ms_highway.human_models import MODELS, ladder
from ms_highway.switching import Switching


def test_a_step_reports_what_was_planned_in_physical_units(played):
    game, state = played("merger")
    step = FixedModel(game, MODELS["naive"]).step(np.asarray(state))
    assert step.plan.shape == step.human.shape == (5, 2)
    np.testing.assert_array_equal(step.control, step.plan[0])
    assert step.human[0] == pytest.approx([0.0, 0.2 * float(state[1, 3])], rel=1e-4)  # only makes up for friction
    assert step.model == "naive"
    assert step.status == "planned"
    assert 0 < step.planning_seconds < 1
    assert step.decision_seconds == 0


def test_switching_compiles_all_rungs_before_its_first_control_and_nothing_later(played):
    game, state = played("merger")
    controller = ModelSwitching(game, Switching(np.array([0.09, 0.17, 0.37]), 0.0, ladder(("naive", "turn", "tom"))))
    controller.step(np.asarray(state))
    sizes = compiled_plan._cache_size(), _decide._cache_size()
    models = set()
    for _ in range(6):
        state = state.at[:, 0].add(state[:, 3] * 0.1)
        step = controller.step(np.asarray(state))
        assert step.compile_seconds == 0
        models.add(step.model)
    dearer = replace(game, robot=replace(game.robot, weights=game.robot.weights * 1.5))
    ModelSwitching(dearer, replace(controller.switching, price=3.0)).step(np.asarray(state))
    assert len(models) > 1
    assert (compiled_plan._cache_size(), _decide._cache_size()) == sizes


def test_a_plan_that_is_not_finite_falls_back_to_the_last_one_and_then_keeps_velocity(played):
    game, state = played("stay_back")
    controller = FixedModel(game, MODELS["turn"])
    first = controller.step(np.asarray(state))
    controller.game = replace(game, robot=replace(game.robot, weights=game.robot.weights * jnp.nan))
    second = controller.step(np.asarray(state))
    assert second.status == "previous plan"
    np.testing.assert_array_equal(second.plan[:-1], first.plan[1:])
    controller.reset()
    third = controller.step(np.asarray(state))
    assert third.status == "keep velocity"
    np.testing.assert_allclose(third.control, [0.0, 0.2 * float(state[0, 3])], rtol=1e-5)


def test_a_state_that_is_no_state_is_refused(played):
    game, state = played("stay_back")
    controller = FixedModel(game, MODELS["naive"])
    with pytest.raises(ValueError, match=r"shape \[cars, 4\].*\(4,\)"):
        controller.step(np.asarray(state)[0])
    with pytest.raises(ValueError, match="car 1 is not finite: speed is nan"):
        controller.step(np.asarray(state.at[1, 3].set(jnp.nan)))


def test_measured_costs_grow_up_the_ladder(played):
    game, state = played("merger")
    naive, _, tom = measure_costs(game, ladder(("naive", "turn", "tom")), np.asarray(state), repeats=15)
    assert 0 < naive < tom
