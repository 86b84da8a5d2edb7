"""Efforts: models by name in fewer or more steps or from the last plan, and their costs."""

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import jax
import numpy as np
import pytest

from ms_highway.envs import MergerEnv
from ms_highway.envs.configuration import read_own
from ms_highway.envs.settings import Settings
from ms_highway.game.game import total_reward
from ms_highway.numerics.solvers import project
from ms_highway.planning.compiled_plans import plan_for
from ms_highway.planning.human_models import HumanModel, Naive, PredictedHuman
from ms_highway.planning.ladders import BEST_LADDER, MODELS, human_model, is_model, known_models, ladder, register
from ms_highway.runtime.compilation import jit_quickly

STRANGE = ["tom@08", "tom@5001", "tom+warm@8", 8]


def compiled(name):
    """The plans of a model, compiled."""
    return jit_quickly(partial(plan_for, (human_model(name),)))


@dataclass(frozen=True)
class Lazy(Naive):
    """Naive by another name."""

    name: ClassVar[str] = "lazy"


@pytest.fixture
def lazy():
    register(Lazy())
    yield "lazy"
    del MODELS["lazy"]


@pytest.mark.parametrize("name", ["naive@10", "tom+warm", "tom@8+warm"])
def test_a_model_has_the_name_that_makes_it(name):
    model = human_model(name)
    assert model.name == name
    assert model.responds == name.startswith("tom")
    assert model.warm == name.endswith("+warm")


@pytest.mark.parametrize("name", STRANGE)
def test_an_invalid_effort_is_refused_with_the_remedy(name):
    assert not is_model(name)
    with pytest.raises(ValueError, match=r"unknown human model .*tom, also in 1 to 5000 steps \(tom@8\)"):
        ladder([name])


@pytest.mark.parametrize(
    "names", [[], ["tom", "tom@40"], ["tom@8+warm", "tom@8"], ["tom@4", "naive"], ["tom@8", "tom@8"]]
)
def test_a_ladder_is_ordered_by_model_and_then_by_number_of_steps(names):
    with pytest.raises(ValueError, match=r"cheapest first.*of the same model fewer steps first"):
        ladder(names)


def test_the_best_ladder_has_a_name_that_is_reserved():
    for names in ("best", ["best"], BEST_LADDER):
        assert tuple(model.name for model in ladder(names)) == BEST_LADDER
    with pytest.raises(ValueError, match="'best'"):
        register(type("Best", (Lazy,), {"name": "best"})())


@pytest.mark.parametrize("base", [HumanModel, PredictedHuman])
def test_a_model_that_neither_predicts_nor_plans_is_refused(base):
    with pytest.raises(ValueError, match=r"'empty' neither predicts nor plans; .* define `predict`"):
        register(type("Empty", (base,), {"name": "empty"})())


def test_registered_models_have_efforts_too(lazy, played):
    game, state = played("merger")
    np.testing.assert_array_equal(*(compiled(name)(game, state).robot for name in ("naive@3", "lazy@3")))
    assert known_models(["lazy@3", "tom@8"]) == ["naive", "idm", "turn", "tom@8", "tom", "lazy@3", "lazy"]


@pytest.mark.parametrize("solver", ["gradient", "newton"])
def test_counted_steps_are_gradient_steps_of_their_own_length_under_any_solver(played, solver):
    game, state = played("merger", solver=solver)
    robot = compiled("naive@1")(game, state).robot
    expected = Naive().predict(game, state) / game.planner.control_scale
    slope = jax.grad(total_reward, argnums=2)(game, state, np.zeros((5, 2)), expected[None])
    np.testing.assert_allclose(robot, project(game.planner, 0.1 * slope), atol=1e-5)


def test_steps_do_not_overshoot_at_longer_horizons(played):
    game, state = played("stay_back")
    game = replace(game, planner=replace(game.planner, horizon=8))
    rewards = []
    for name in ("naive@1", "naive@30"):
        rewards.append(float(total_reward(game, state, *compiled(name)(game, state))))
    assert rewards[1] > rewards[0]


def test_costs_are_those_given_or_proportional_to_the_steps():
    def costs(given, *names, **config):
        anything = {"controller": {"type": "switching", "lambda": 1.0}}
        config = MergerEnv.checked_config({"ladder": list(names), "costs": given, **anything, **config})
        return read_own(Settings, config).seconds

    published = costs("published", "naive", "tom@8", "tom@8+warm", "tom+warm")
    assert published["tom@8"] == published["tom@8+warm"] == pytest.approx(0.37 * 8 / 20)
    assert published["tom+warm"] == published["tom"] == 0.37
    assert costs("published", "tom@8", iterations=40)["tom@8"] == pytest.approx(0.37 * 8 / 40)
    of_seconds = costs("published", "naive@4", "tom@8", solver="convex_newton")  # whose steps are 8, and 4 if answered
    assert of_seconds["naive@4"] == pytest.approx(0.09 / 2)
    assert of_seconds["tom@8"] == pytest.approx(0.37 * 2)
    given = costs({"naive": 0.1, "tom": 0.4, "tom@8": 0.3}, "naive", "tom@4", "tom@8+warm")
    assert given["tom@4"] == pytest.approx(0.08)
    assert given["tom@8+warm"] == 0.3
    assert costs("published", "naive", controller={"type": "fixed", "model": "turn@5"})["turn@5"] == 0.17 / 4
    assert not costs("measured", "naive", "tom@8")
    with pytest.raises(ValueError, match="unknown key 'tom@0'"):
        costs({"naive": 0.1, "tom@0": 1}, "naive")
