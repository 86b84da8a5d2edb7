"""Steadiness of driving: what small noise changes."""

import json

import pytest
from commands import run

from ms_highway.benchmarks.speed import AFTER, steadiness
from ms_highway.experiments.comparison import Comparison

NAIVE = Comparison({"merger": ["naive"]}, seeds=8, config={"ladder": ["naive"]})


def test_a_centimetre_of_noise_in_the_start_of_a_merger_is_forgotten_within_twenty_steps():
    small, usual = steadiness(NAIVE, "merger", "naive", [1e-3, 1e-2])["noise"].values()
    change = usual["change_m"]
    assert 5e-3 < change["1"]["p50"] < 2e-2  # the noise itself
    assert change["20"]["p50"] < change["5"]["p50"] < change["1"]["p50"]
    assert change["20"]["p95"] < 1e-2
    assert usual["growth"] < 1
    for step in map(str, AFTER):  # the same noise, ten times as large
        assert change[step]["p50"] == pytest.approx(10 * small["change_m"][step]["p50"], rel=0.3)
    assert 0 < small["reward"]["absolute"] < usual["reward"]["absolute"] < 1e-2
    assert usual["reward"]["low"] < usual["reward"]["mean"] < usual["reward"]["high"]
    assert (usual["collisions"], usual["success_changes"]) == ([0, 0], None)


@pytest.mark.slow
def test_the_command_shows_figures_for_each_noise_in_observations(tmp_path, capsys):
    file = tmp_path / "noise.json"
    options = f"--seeds 2 --first-seed 7 --controllers naive --set ladder=naive, --json {file}"
    run(f"bench merger --noise 1e-5 0.001 --seen {options}")
    (own,) = json.loads(file.read_text())["merger"].values()
    assert (own["seeds"], own["seen"]) == ([7, 2], True)
    assert list(own["noise"]) == ["1e-05", "0.001"]
    assert all(figures["growth"] > 0 for figures in own["noise"].values())
    assert "growth" in capsys.readouterr().out
