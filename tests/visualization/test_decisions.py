"""Single episodes: when the model changed, and why."""

import numpy as np
import pytest

from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import one_episode
from ms_highway.experiments.runner import read, run
from ms_highway.visualization.colors import color_of
from ms_highway.visualization.decisions import decisions


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    directory = tmp_path_factory.mktemp("merger")
    comparison = Comparison({"merger": ["schedule:tom=3,turn=1,naive", "switching:0.01"]}, seeds=1)
    assert list(run(comparison, directory)) == [0, 1, 2]
    return read(comparison, directory)


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
