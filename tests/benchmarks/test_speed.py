"""Speed of the closed loop: `ms-highway bench`."""

import json

import pytest
from commands import run


@pytest.mark.slow
def test_the_command_times_every_rung_and_switching(tmp_path, capsys):
    run(f"bench merger --set ladder=naive, --json {tmp_path / 'bench.json'}")
    measured = json.loads((tmp_path / "bench.json").read_text())["merger"]
    assert list(measured) == ["naive", "switching:0.6", "switching:0.1"]
    assert all(set(one) == {"plan_us", "decision_us", "step_us", "environment"} for one in measured.values())
    assert measured["naive"]["decision_us"] == 0 < measured["switching:0.1"]["decision_us"]
    printed = capsys.readouterr().out
    assert "merger: medians, on one core" in printed
    assert f"{measured['naive']['plan_us']['p50']:.0f}" in printed
