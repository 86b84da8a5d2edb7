"""Tables and figures of what was learned."""

import io

import numpy as np
import pytest
from rich.console import Console

from ms_highway.game.learned_reward import shipped
from ms_highway.irl.evaluation import LEVELS, Evaluation
from ms_highway.irl.moments import cut_moments
from ms_highway.irl.outlook import expected_path
from ms_highway.irl.peers import steady_motion
from ms_highway.irl.predictors import PREDICTORS
from ms_highway.visualization.irl.prediction import counts_figure, evaluation_figures, examples, paths_figure
from ms_highway.visualization.irl.tables import evaluation_tables, learned_tables

KINDS = ("fde", "ade", "rmse", "miss", "log_p", *(f"inside {level}" for level in LEVELS))


def evaluation():
    errors = {str(horizon): 0.5 * horizon for horizon in (1, 2, 3, 5)}
    rows = {name: {kind: dict(errors) for kind in KINDS} for name in PREDICTORS}
    for place, row in enumerate(rows.values()):
        row["miss"] = dict.fromkeys(errors, 0.1 * (place + 1))
        row["inside 90"] = dict.fromkeys(errors, 0.9 - 0.01 * place)
    windows = {"1": 4.0, "2": 4.0, "3": 4.0, "5": 0.0}
    braking = {"windows": windows, **{name: {"1": 0.5, "2": 1.0, "3": 1.5} for name in PREDICTORS}}
    likelihood = {"model": 25.0, "constant_velocity": 24.0, "windows": 7}
    return Evaluation(rows, {"distance": {"braking": braking}, "log_p": {"braking": braking}}, likelihood, 12, 3,
                      "predicted")  # fmt: skip


def printed(tables):
    console = Console(file=io.StringIO(), width=200)
    for table in tables:
        console.print(table)
    return console.file.getvalue()


def test_measures_are_drawn_against_the_horizon_for_all_predictors():
    figures = evaluation_figures(evaluation())
    left, right = figures["errors"].axes
    assert len(left.lines) == len(figures["likelihood"].axes[0].lines) == len(PREDICTORS)
    for place, (distance, miss) in enumerate(zip(left.lines, right.lines, strict=True)):
        assert list(distance.get_xdata()) == [1, 2, 3, 5]
        assert list(distance.get_ydata()) == [0.5, 1.0, 1.5, 2.5]
        assert list(miss.get_ydata()) == pytest.approx([0.1 * (place + 1)] * 4)
    *predictors, nominal = figures["calibration"].axes[1].lines
    assert list(nominal.get_ydata()) == [0.9, 0.9]
    assert list(predictors[1].get_ydata()) == pytest.approx([0.89] * 4)


def test_examples_are_distinct_and_their_recorded_paths_are_drawn(us101):
    moments = cut_moments(us101[:1])
    off = np.linalg.norm(expected_path(steady_motion(moments)) - moments.recorded, axis=-1)
    chosen = examples(moments, off)
    assert len(chosen) == len(set(chosen.values())) == 4
    faster = moments.tracks(moments.future)[:, -1, 3] - moments.drivers(moments.now)[:, 3]
    assert faster[chosen["the strongest braking"]] == np.nanmin(faster)
    figure = paths_figure(us101[:1], shipped("us101").drivers)
    for axes, driver in zip(figure.axes, chosen.values(), strict=True):
        drawn = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 51]
        recorded = moments.recorded[driver] - moments.drivers(moments.now)[driver, :1] * [1, 0]
        assert any(np.allclose(line[1:], recorded) for line in drawn)
        low, high = axes.get_ylim()
        assert low > high  # the driver's left is up


def test_feature_counts_are_drawn_in_shares_of_the_larger_one():
    counts = shipped("demonstrations").feature_counts
    human, model = (
        [bar.get_width() for bar in bars] for bars in counts_figure(shipped("demonstrations")).axes[0].containers
    )
    assert np.abs([human, model]).max(axis=0) == pytest.approx(np.ones(len(human)))
    for name, ours, theirs in zip(counts["human"], human, model, strict=True):
        assert ours * counts["model"][name] == pytest.approx(theirs * counts["human"][name], abs=1e-9)


def test_tables_show_what_was_found():
    first, *_, last = evaluation_tables(evaluation())
    assert "12 predictions of 3 drivers, others predicted" in printed([first])
    assert printed([first]).count(" 2.50") == 3 * len(PREDICTORS)  # FDE, RMSE and log p
    assert "90.0%" in printed([first])
    assert printed(evaluation_tables(evaluation())[1:2]).count("1.50") == len(PREDICTORS)
    assert "25.00" in printed([last])
    text = printed(learned_tables(shipped("us101"), {"headway": 0.5}))
    for shown in ("learned from 6856 windows", "0.5 ", "patiences", "headway while changing lanes"):
        assert shown in text
