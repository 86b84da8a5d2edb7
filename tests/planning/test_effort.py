"""Efforts: models by name in fewer or more steps or from the last plan, and their
costs.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import numpy as np
import pytest

from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.configuration import read_own
from ms_highway.envs.settings import Settings
from ms_highway.game.game import total_reward
from ms_highway.planning.compiled_plans import CompiledPlans, plan
from ms_highway.planning.human_models import HumanModel, Naive, PredictedHuman
from ms_highway.planning.ladders import (
    BEST_LADDER,
    MODELS,
    human_model,
    is_model,
    known_models,
    ladder,
    register,
)
from ms_highway.runtime.compilation import jit_quickly

rewards = jit_quickly(total_reward)


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


@pytest.mark.parametrize("name", ["tom@08", "tom@5001", "tom+warm@8", 8])
def test_an_invalid_effort_is_refused_with_the_remedy(name):
    assert not is_model(name)
    with pytest.raises(
        ValueError,
        match=r"unknown human model .*tom, also in 1 to 5000 steps \(tom@8\)",
    ):
        ladder([name])


@pytest.mark.parametrize(
    "names", [[], ["tom", "tom@40"], ["tom@8+warm", "tom@8"], ["tom@4", "naive"]]
)
def test_a_ladder_is_ordered_by_model_and_number_of_steps(names):
    with pytest.raises(
        ValueError, match=r"cheapest first.*of the same model fewer steps first"
    ):
        ladder(names)


def test_the_best_ladder_has_a_name_that_is_reserved():
    for names in ("best", ["best"], BEST_LADDER):
        assert tuple(model.name for model in ladder(names)) == BEST_LADDER
    with pytest.raises(ValueError, match="'best'"):
        register(type("Best", (Lazy,), {"name": "best"})())


@pytest.mark.parametrize("base", [HumanModel, PredictedHuman])
def test_a_model_that_neither_predicts_nor_plans_is_refused(base):
    with pytest.raises(
        ValueError, match=r"'empty' neither predicts nor responds; define `predict`"
    ):
        register(type("Empty", (base,), {"name": "empty"})())


def test_counted_gradient_steps_have_their_own_length_under_any_model(lazy, played):
    game, state = played("merger")
    start = np.zeros((5, 2), np.float32)
    scale = game.planner.control_scale
    expected = Naive().predict(game, np.array(state)) / scale
    slope = jit_quickly(jax.grad(total_reward, argnums=2))(
        game, state, start, expected[None]
    )
    for name in ("naive@1", "lazy@1"):
        np.testing.assert_allclose(
            plan(game, state, name).robot / scale, 0.1 * np.array(slope), atol=1e-5
        )
    assert known_models(["lazy@3", "tom@8"]) == [
        "naive",
        "idm",
        "turn",
        "tom@8",
        "tom",
        "lazy@3",
        "lazy",
    ]


def test_steps_do_not_overshoot_at_longer_horizons(played):
    game, state = played("stay_back")
    game = replace(game, planner=replace(game.planner, horizon=8))
    plans = (
        CompiledPlans(game, [human_model(name)]).plan(state, [0])[0]
        for name in ("naive@1", "naive@30")
    )
    one, thirty = (rewards(game, state, *solution.plan) for solution in plans)
    assert thirty > one


def test_costs_are_those_given_or_proportional_to_the_steps():
    def costs(given, *names, **config):
        config = {
            "controller": {"type": "switching", "lambda": 1.0},
            "ladder": [*names],
            "costs": given,
            **config,
        }
        checked = ENVIRONMENTS["merger"].checked_config(config)
        return read_own(Settings, checked).counted.seconds

    published = costs("published", "naive", "tom@8", "tom@8+warm", "tom+warm")
    assert published["tom@8"] == published["tom@8+warm"] == pytest.approx(0.37 * 8 / 20)
    assert published["tom+warm"] == published["tom"] == 0.37

    # Plans of seconds take 8 steps, and 4 to which humans respond.
    of_seconds = costs("published", "naive@4", "tom@8", solver="convex_newton")
    assert of_seconds["naive@4"] == pytest.approx(0.09 / 2)
    assert of_seconds["tom@8"] == pytest.approx(0.37 * 2)

    by_name = {"naive": 0.1, "tom": 0.4, "tom@8": 0.3}
    given = costs(by_name, "naive", "tom@4", "tom@8+warm")
    assert given["tom@4"] == pytest.approx(0.08)
    assert given["tom@8+warm"] == 0.3

    fixed = {"type": "fixed", "model": "turn@5"}
    assert costs("published", "naive", controller=fixed)["turn@5"] == 0.17 / 4
    assert not costs("measured", "naive", "tom@8")
    with pytest.raises(ValueError, match="unknown key 'tom@0'"):
        costs({"naive": 0.1, "tom@0": 1}, "naive")
