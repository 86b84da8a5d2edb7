"""Reward against computation, from summaries."""

import numpy as np
import pandas as pd
import pytest

from ms_highway.envs.registry import controller_config
from ms_highway.visualization.tradeoff import curve

ROWS = [
    ("naive", 1.0, 90.0),
    ("tom", 6.0, 370.0),
    ("switching:0.1", 4.8, 185.0),
    ("switching:0.01", 5.4, 296.0),
    ("schedule:tom=4,naive", 3.0, 118.0),
    ("random:naive=0.5,tom=0.5", 5.8, 100.0),
    ("learned:0.1", 5.9, 150.0),
    ("learned:1", 5.0, 120.0),
    ("learned:0.1:own.npz", 5.5, 160.0),
]


@pytest.fixture
def summaries():
    table = pd.DataFrame(ROWS, columns=["controller", "reward", "counted_ms"])
    configs = [controller_config(name.removesuffix(":own.npz")) for name in table["controller"]]  # which is not read
    return table.assign(
        scenario="merger",
        kind=[config["type"] for config in configs],
        price=[config.get("lambda") for config in configs],
        episodes=30,
        reward_low=table["reward"] - 0.1,
        reward_high=table["reward"] + 0.1,
        planning_ms=table["counted_ms"] / 100,
        decision_ms=table["controller"].str.startswith("switching") * 0.1,
    )


def test_the_curve_shows_every_controller_and_joins_each_kind_that_chooses_online(summaries):
    counted, measured = (figure := curve(summaries, "merger")).axes
    points = np.concatenate([line.get_xydata() for line in counted.lines])
    for _, reward, milliseconds in ROWS:
        assert (np.abs(points - [milliseconds, reward]).max(axis=1) < 1e-9).any()
    assert measured.get_xlim()[1] < 5
    assert {text.get_text() for text in counted.texts} == {"0.1", "0.01", "1"}
    (legend,) = figure.legends
    assert {"switching, by lambda", "learned, by lambda"} <= {text.get_text() for text in legend.get_texts()}
    first = {tuple(line.get_xydata()[0]): line for line in counted.lines if len(line.get_xydata())}
    learned, switching = first[150.0, 5.9], first[296.0, 5.4]
    assert learned.get_xydata().tolist() == [[150.0, 5.9], [120.0, 5.0]]
    assert learned.get_color() != switching.get_color()
