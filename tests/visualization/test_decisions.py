"""Single episodes: when the model changed, and why."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import one_episode
from ms_highway.experiments.runner import read, run
from ms_highway.planning.human_models import MODELS, TheoryOfMind, register
from ms_highway.visualization.colors import color_of
from ms_highway.visualization.decisions import decisions


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    directory = tmp_path_factory.mktemp("merger")
    comparison = Comparison({"merger": ["schedule:tom=3,turn=1,naive", "switching:0.01"]}, seeds=1)
    assert list(run(comparison, directory)) == [0, 1, 2]
    return read(comparison, directory)


def test_a_schedule_plans_with_the_models_in_its_order_and_goes_on_with_the_last(records):
    episode = one_episode(records, "merger", "schedule:tom=3,turn=1,naive", 0)
    assert episode["model"].tolist() == ["tom"] * 3 + ["turn"] + ["naive"] * 36
    assert episode["counted_seconds"].tolist() == [0.37] * 3 + [0.17] + [0.09] * 36
    assert (episode["decision_seconds"] == 0).all()


def assert_gains_are_drawn(axes, episode, model):
    """In the model's colour, at the steps that they were recorded at."""
    (line,) = [line for line in axes.lines if line.get_color() == color_of(model)]
    np.testing.assert_array_equal(line.get_xydata(), episode[["step", f"gain_{model}"]])


def test_decisions_are_drawn_at_the_steps_and_in_the_models_that_were_recorded(records):
    episode = one_episode(records, "merger", "switching:0.01", 0)
    figure = decisions([episode], one_episode(records, "merger", "schedule:tom=3,turn=1,naive", 0))
    gains, rewards = figure.axes
    assert_gains_are_drawn(gains, episode, "tom")
    np.testing.assert_array_equal(rewards.lines[0].get_ydata(), episode["reward"])


def test_an_episode_that_is_not_there_is_named(records):
    with pytest.raises(ValueError, match="no episode of 'tom' in 'merger' with seed 0"):
        one_episode(records, "merger", "tom", 0)


@dataclass(frozen=True)
class Brief(TheoryOfMind):
    name: ClassVar[str] = "brief"

    def plan(self, game, state, start=None):
        return super().plan(replace(game, planner=replace(game.planner, iterations=5)), state, start)


@pytest.fixture
def brief():
    register(Brief(), before="tom")
    yield
    del MODELS["brief"]


@pytest.mark.slow
def test_a_model_of_ones_own_is_compared_recorded_and_drawn_like_the_papers(brief, tmp_path):
    assert list(MODELS) == ["naive", "idm", "turn", "brief", "tom"]
    costs = {"naive": 0.09, "brief": 0.12}
    config = {"costs": costs, "ladder": ["naive", "brief"]}
    comparison = Comparison({"merger": ["brief", "switching:0.01"]}, 1, config=config)
    list(run(comparison, tmp_path))
    records = read(comparison, tmp_path)
    switching = one_episode(records, "merger", "switching:0.01", 0)
    assert set(switching["model"]) == {"naive", "brief"}
    assert switching["gain_brief"].notna().any()
    assert set(switching["counted_seconds"]) == {0.09, 0.12}
    assert one_episode(records, "merger", "brief", 0)["reward"].mean() > 4  # it opens the gap
    assert_gains_are_drawn(decisions([switching]).axes[0], switching, "brief")
    older = switching.drop(columns="gain_brief").assign(model="naive")  # from before the model was known
    assert len(decisions([older]).axes) == 2
    with pytest.raises(ValueError, match="is 'published', without seconds for 'brief'; say 'measured' or give them"):
        Comparison({"merger": ["naive"]}, config={"ladder": ["naive", "brief"]}).check()
