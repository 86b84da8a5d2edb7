"""Planning time T(M): one record, which decisions, environments and batches share."""

import jax
import numpy as np
import pytest
from episodes import drive, make

from ms_highway import Costs
from ms_highway.planning.costs import measure_costs
from ms_highway.planning.ladders import ladder

SECONDS = {"naive": 0.25, "turn": 0.5, "tom": 1.0}


def test_a_human_adds_the_cost_over_the_first_model():
    costs = Costs.of(SECONDS, humans=3)
    assert costs.seconds == SECONDS
    assert costs.of_models(["naive"] * 3) == 0.25
    assert costs.of_models(["tom", "naive", "turn"]) == 0.25 + 0.75 + 0.0 + 0.25

    of_one = Costs.of(SECONDS, humans=1)
    assert of_one.of_models(["tom"]) == 1.0


def test_names_and_numbers_of_rungs_count_the_same_time():
    costs = Costs.of(SECONDS, humans=2).select(["naive", "tom"])
    plans = [["naive", "naive"], ["naive", "tom"], ["tom", "tom"]]
    by_name = [costs.of_models(names) for names in plans]

    rungs = np.array([[0, 0], [0, 1], [1, 1]])
    np.testing.assert_array_equal(costs.total(rungs), by_name)
    traced = jax.jit(Costs.total)(costs, jax.numpy.array(rungs))
    np.testing.assert_allclose(traced, by_name)


def test_an_unknown_model_has_no_time():
    costs = Costs.of(SECONDS, humans=1).select(["lost", "tom"])
    assert costs.of_models(["lost"]) is None
    assert costs.of_models(["elsewhere"]) is None
    assert costs.seconds == {"tom": 1.0}
    total = costs.total(np.array([[0], [1]]))
    np.testing.assert_array_equal(total, [np.nan, 1.0])


def test_other_numbers_are_not_compiled_again():
    total = jax.jit(lambda costs, rungs: costs.total(rungs))
    rungs = jax.numpy.array([0, 2])
    for factor in (1, 2, 3):
        seconds = {name: factor * time for name, time in SECONDS.items()}
        costs = Costs.of(seconds, humans=2)
        assert total(costs, rungs) == factor * 1.0
    assert total._cache_size() == 1


@pytest.mark.parametrize("scene", ["merger", "dense_merge"])
def test_measured_costs_name_the_ladder(played, scene):
    game, state = played(scene)
    rungs = ladder(["naive", "turn"])
    costs = measure_costs(game, rungs, state, quantile=0.5, way_out=False)
    assert list(costs.seconds) == ["naive", "turn"]
    assert min(costs.seconds.values()) > 0


def test_an_environment_carries_the_costs_that_its_rule_chooses_by():
    env = make("merger", "switching:0.1", costs="measured", ladder=["naive", "turn"])
    env.reset(seed=0)
    inner = env.unwrapped
    assert inner.seconds == {}
    counted = [info["counted_seconds"] for info in drive(env, steps=3).infos]
    assert inner.robot.controller.rule.costs.seconds == inner.seconds
    assert set(counted) <= set(inner.seconds.values())
