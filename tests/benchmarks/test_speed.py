"""Speed of the closed loop: `ms-highway bench`."""

import json

import pytest
from commands import run

KEYS = {
    "plan_us",
    "decision_us",
    "step_us",
    "environment",
    "batch",
    "memory_mib",
    "first_seconds",
    "devices",
}


@pytest.mark.slow
def test_the_command_times_controllers_live_and_in_batches(tmp_path, capsys):
    file = tmp_path / "bench.json"
    run(f"bench merger --set ladder=naive, --batches 1 20 --json {file}")
    measured = json.loads(file.read_text())["merger"]
    assert list(measured) == ["naive", "switching:0.6", "switching:0.1"]
    assert measured["naive"]["decision_us"] == 0
    assert measured["switching:0.1"]["decision_us"] > 0
    for one in measured.values():
        assert set(one) == KEYS
        assert 0 < one["plan_us"]["p50"] <= one["plan_us"]["p99"] < 1e6
        assert min(one["step_us"], one["environment"], one["first_seconds"]) > 0
        assert min(one["batch"].values()) > 1
        assert one["memory_mib"]["20"] >= one["memory_mib"]["1"] > 100
        assert one["devices"].endswith(" of kind cpu")
    printed = capsys.readouterr().out
    assert "merger: medians, on one core" in printed
    assert f"{measured['naive']['plan_us']['p50']:.0f}" in printed
