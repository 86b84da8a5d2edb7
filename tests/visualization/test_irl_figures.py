"""Tables and figures of what was learned."""

import numpy as np
import pytest

from ms_highway.game.learned_reward import shipped
from ms_highway.irl.commonroad import read_directory
from ms_highway.irl.evaluation import LEVELS, Evaluation
from ms_highway.irl.prediction import PREDICTORS
from ms_highway.visualization.irl import evaluation_figures, evaluation_tables, learned_tables, paths_figure

KINDS = ("fde", "ade", "rmse", "miss", "log_p", *(f"inside {level}" for level in LEVELS))


def evaluation():
    errors = {str(horizon): 0.5 * horizon for horizon in (1, 2, 3, 5)}
    rows = {name: {kind: dict(errors) for kind in KINDS} for name in PREDICTORS}
    for place, row in enumerate(rows.values()):
        row["miss"] = dict.fromkeys(errors, 0.1 * (place + 1))
        row["inside 90"] = dict.fromkeys(errors, 0.9 - 0.01 * place)
    windows = {"1": 4.0, "2": 4.0, "3": 4.0, "5": 0.0}
    braking = {"windows": windows, **{name: {"1": 0.5, "2": 1.0, "3": 1.5} for name in PREDICTORS}}
    return Evaluation(rows, {"distance": {"braking": braking}, "log_p": {"braking": braking}}, 12, 3)


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


@pytest.mark.slow
def test_recorded_and_predicted_paths_of_a_snapshot_are_drawn(us101_directory):
    (recording,) = read_directory(us101_directory, 1)
    (axes,) = paths_figure([recording], shipped("us101").drivers).axes
    drawn = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 51]
    assert len(drawn) % 4 == 0
    tracks = recording.states[..., :2]
    for path in drawn[: len(drawn) // 4]:
        starts = np.argwhere((tracks == path[0]).all(axis=-1)).tolist()  # several, of a car that stands
        assert any(np.array_equal(path, tracks[step : step + 51, car]) for step, car in starts)


def test_tables_show_what_was_found():
    metrics, regimes, *_ = evaluation_tables(evaluation())
    assert metrics.attrs["title"] == "12 predictions of 3 drivers"
    assert (metrics == "2.50").to_numpy().sum() == 3 * len(PREDICTORS)  # FDE, RMSE and log p
    assert "90.0%" in metrics.to_numpy()
    assert (regimes == "1.50").to_numpy().sum() == len(PREDICTORS)
    weights, drivers = learned_tables(shipped("us101"), {"headway": 0.5})
    assert weights.attrs["title"] == "learned from 6856 segments"
    assert weights["true"].loc["headway"] == "0.5"
    assert {"patiences", "headway while changing lanes"} <= set(drivers.index)
