"""How long plans and decisions take."""

import pytest

from ms_highway.benchmarks.latency import bench


@pytest.mark.slow
def test_bench_measures_plans_decisions_steps_and_compilation():
    name, result = next(bench("merger", ladder=["naive", "turn"]))
    assert name == "naive"
    assert 0 < result["plan_us"]["p50"] <= result["plan_us"]["p99"] < 1e6
    assert 0 < result["decision_us"] < 1e6
    assert 0 < result["step_us"] < 1e6
    assert 0 < result["compile_s"]["cached"] < result["compile_s"]["cold"]
    assert result["flop"] > 1e5
    assert set(result["plans_per_s"]) == {"1", "32", "1024"}
