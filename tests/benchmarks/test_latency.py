"""How long plans and decisions take; in a file of its own, as it forgets all that was compiled before."""

import numpy as np
import pytest

from ms_highway import plan
from ms_highway.benchmarks.casadi_peer import compiled_peer
from ms_highway.benchmarks.latency import bench
from ms_highway.experiments.runner import make_environment


@pytest.mark.slow
def test_bench_measures_a_plan_and_a_peer_that_plans_the_same():
    name, result = next(bench("stay_back", peer=True))
    assert name == "naive"
    assert 0 < result["plan_us"]["p50"] <= result["plan_us"]["p99"] < 1e6
    assert 0 < result["peer_us"]["p50"] < 1e6
    assert 0 < result["decision_us"] < 1e6
    assert 0 < result["step_us"] < 1e6
    assert 0 < result["compile_s"]["cached"] < result["compile_s"]["cold"]
    assert result["flop"] > 1e5
    assert set(result["plans_per_s"]) == {"1", "32", "1024"}


@pytest.mark.slow
@pytest.mark.parametrize("semantics", ["paper", "released"])
def test_the_peers_theory_of_mind_plans_the_same(semantics, tmp_path):
    env = make_environment("merger", "tom", semantics=semantics).unwrapped
    env.reset(seed=0)
    game, state = env.game, env.car_states
    call, _ = compiled_peer(game, "tom", len(state), tmp_path)
    ours = plan(game, state, "tom")[0] / np.asarray(game.planner.control_scale)
    np.testing.assert_allclose(call(state), ours, atol=1e-3)
