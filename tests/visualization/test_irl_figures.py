"""Tables and figures of what was learned, and the recovery of known weights."""

import io
import json

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread
from rich.console import Console

from ms_highway.cli.main import main
from ms_highway.game.learned_reward import shipped
from ms_highway.irl.evaluation import load_evaluation
from ms_highway.irl.learning import SIMULATED
from ms_highway.irl.moments import cut_moments
from ms_highway.irl.outlook import Modes, expected_path
from ms_highway.irl.peers.kinematic import constant_velocity
from ms_highway.irl.predictors import PREDICTORS, Prediction
from ms_highway.irl.recordings.demonstrators import DRIVER_WEIGHTS
from ms_highway.irl.recovery import recover
from ms_highway.irl.regimes import examples
from ms_highway.visualization.irl.prediction import calibration_figure, counts_figure, errors_figure, paths_figure
from ms_highway.visualization.irl.prediction import likelihood_figure as density_figure
from ms_highway.visualization.irl.recovery import likelihood_figure, weights_figure
from ms_highway.visualization.irl.tables import drivers_table, evaluation_tables, recovery_table

KINDS = ("fde", "ade", "rmse", "miss", "log_p", "inside 50", "inside 90", "inside 99")


def evaluation():
    errors = {str(horizon): 0.5 * horizon for horizon in (1, 2, 3, 5)}
    rows = {name: {kind: dict(errors) for kind in KINDS} for name in PREDICTORS}
    for place, row in enumerate(rows.values()):
        row["miss"] = dict.fromkeys(errors, 0.1 * (place + 1))
        row["inside 90"] = dict.fromkeys(errors, 0.9 - 0.01 * place)
    windows = {"1": 4.0, "2": 4.0, "3": 4.0, "5": 0.0}
    braking = {"windows": windows, **{name: {"1": 0.5, "2": 1.0, "3": 1.5} for name in PREDICTORS}}
    likelihood = {"model": 25.0, "constant_velocity": 24.0, "windows": 7}
    situations = {"distance": {"braking": braking}, "log_p": {"braking": braking}}
    counts = {"windows": 12, "tracks": 3, "others": "predicted"}
    return {"predictors": rows, "situations": situations, "likelihood": likelihood, **counts}


def recovery(drivers=("maxent", "mpc"), numbers=(4, 16)):
    rows = []
    for driver in drivers:
        for number in numbers:
            for place, name in enumerate(SIMULATED.learned):
                true, ratio, spread = DRIVER_WEIGHTS[name], 1 + place / number, 2 * (place + 0.1) / number
                learned = true * ratio
                row = {"driver": driver, "demonstrations": number, "weight": name, "true": true, "learned": learned}
                row |= {"low": learned * np.exp(-spread), "high": learned * np.exp(spread), "spread": spread}
                row |= {"identifiable": spread < 0.5, "log_likelihood": 10 - 1 / number, "log_likelihood_true": 10.0}
                rows.append(row | {"temperature": 1e-3, "regret": 1 / number})
    return pd.DataFrame(rows)


def printed(table):
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()


def test_weights_are_drawn_as_ratios_to_the_true_ones_and_hollow_where_not_identifiable():
    rows = recovery()
    figure = weights_figure(rows)
    for axes, driver in zip(figure.axes, ("maxent", "mpc"), strict=True):
        assert axes.get_title() == driver
        assert axes.get_yscale() == "log"
        points = [line for line in axes.lines if line.get_marker() == "o"]
        own = rows[rows["driver"] == driver]
        assert sorted(y for line in points for y in line.get_ydata()) == pytest.approx(
            sorted(own["learned"] / own["true"])
        )
        hollow = sum(len(line.get_ydata()) for line in points if line.get_markerfacecolor() == "white")
        assert hollow == (~own["identifiable"]).sum() > 0


def test_likelihood_and_regret_are_drawn_against_the_number_of_demonstrations():
    figure = likelihood_figure(recovery())
    upper, lower = figure.axes[0], figure.axes[2]
    assert list(upper.lines[0].get_xdata()) == [4, 16]
    assert list(upper.lines[0].get_ydata()) == [9.75, 9.9375]
    assert list(upper.lines[1].get_ydata()) == [10, 10]
    assert list(lower.lines[0].get_ydata()) == [25, 6.25]  # per cent


def test_errors_and_misses_are_drawn_against_the_horizon_for_all_predictors():
    left, right = errors_figure(evaluation()).axes
    assert len(left.lines) == len(PREDICTORS)
    for place, (distance, miss) in enumerate(zip(left.lines, right.lines, strict=True)):
        assert list(distance.get_xdata()) == list(miss.get_xdata()) == [1, 2, 3, 5]
        assert list(distance.get_ydata()) == [0.5, 1.0, 1.5, 2.5]
        assert list(miss.get_ydata()) == pytest.approx([0.1 * (place + 1)] * 4)


def test_calibration_and_likelihood_are_drawn_against_the_horizon():
    panels = calibration_figure(evaluation()).axes
    assert [axes.get_title() for axes in panels] == ["region of 50 %", "region of 90 %", "region of 99 %"]
    *predictors, nominal = panels[1].lines
    assert list(nominal.get_ydata()) == [0.9, 0.9]
    assert list(predictors[1].get_ydata()) == pytest.approx([0.89] * 4)
    assert len(density_figure(evaluation()).axes[0].lines) == len(PREDICTORS)


def test_examples_are_distinct_and_their_recorded_and_predicted_paths_are_drawn(us101, tmp_path):
    moments = cut_moments(us101[:2])
    kept = constant_velocity(moments)
    recorded, start = moments.recorded, moments.now[moments.predicted]
    chosen = examples(moments, np.linalg.norm(expected_path(kept) - recorded, axis=-1))
    assert len(chosen) == len(set(chosen.values())) == 4
    whole = np.moveaxis(moments.future, 1, 2)[moments.predicted][:, -1, 3] - start[:, 3]
    assert whole[chosen["the strongest braking"]] == np.nanmin(whole)
    some = list(chosen.values())
    prediction = Prediction(Modes(*(np.asarray(part)[some] for part in kept)), shipped("us101").drivers.spread)
    figure = paths_figure(moments, {"constant_velocity": prediction, "model": prediction}, chosen)
    for axes, driver in zip(figure.axes, some, strict=True):
        markers = {line.get_marker(): line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 51}
        origin = start[driver, :1] * [1, 0]
        np.testing.assert_allclose(markers["D"][1:], recorded[driver] - origin)
        np.testing.assert_allclose(markers["s"][1:], expected_path(kept)[driver] - origin, atol=1e-4)
        low, high = axes.get_ylim()
        assert low > high  # the driver's left is up
    figure.savefig(tmp_path / "paths.png")
    assert imread(tmp_path / "paths.png").std() > 0.01


def test_feature_counts_are_drawn_in_shares_of_the_larger_one():
    learned = shipped("demonstrations")
    human, model = figure_bars = [
        [bar.get_width() for bar in bars] for bars in counts_figure(learned).axes[0].containers
    ]
    assert np.abs(figure_bars).max(axis=0) == pytest.approx(np.ones(len(human)))
    for name, ours, theirs in zip(learned.feature_counts["human"], human, model, strict=True):
        counts = learned.feature_counts["human"][name], learned.feature_counts["model"][name]
        assert ours * counts[1] == pytest.approx(theirs * counts[0], abs=1e-9)


def test_tables_show_what_was_found():
    text = printed(recovery_table(recovery()))
    assert "(1.5)" in text  # not identifiable
    assert "25.00%" in text
    tables = evaluation_tables(evaluation())
    assert "12 predictions of 3 drivers, others predicted" in printed(tables[0])
    assert printed(tables[0]).count(" 2.50") == 3 * len(PREDICTORS)  # FDE, RMSE and log p
    assert "90.0%" in printed(tables[0])
    assert printed(tables[1]).count("1.50") == len(PREDICTORS)
    assert "25.00" in printed(tables[-1])
    drivers = printed(drivers_table(shipped("us101").drivers))
    assert "patiences" in drivers
    assert "headway while changing lanes" in drivers


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read as an evaluation"),
        ("[]", "is no evaluation"),
        (json.dumps({**evaluation(), "predictors": {}}), "lacks predictors.model, predictors.constant_velocity"),
        (json.dumps({key: value for key, value in evaluation().items() if key != "tracks"}), "lacks tracks"),
        (json.dumps({key: value for key, value in evaluation().items() if key != "others"}), "lacks others"),
        (
            json.dumps({**evaluation(), "likelihood": {"model": 1.0, "windows": 2}}),
            "lacks likelihood.constant_velocity",
        ),
        (json.dumps({**evaluation(), "situations": {"distance": {}}}), "lacks situations.log_p"),
    ],
)
def test_what_is_no_evaluation_is_refused(content, message, tmp_path):
    path = tmp_path / "evaluation.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=message):
        load_evaluation(path)
    path.write_text(json.dumps(evaluation()))
    assert load_evaluation(path) == evaluation()


@pytest.mark.parametrize(
    ("numbers", "held_out", "message"),
    [([], 1, "one at least"), ([0], 1, "one at least"), ([1], 0, "one at least"), ([20], 2, "takes 22: record more")],
)
def test_recovery_needs_enough_demonstrations(numbers, held_out, message, us101):
    with pytest.raises(ValueError, match=message):
        recover(us101[:2], numbers, held_out=held_out)


def test_commands_refuse_what_they_cannot_use_before_anything_is_written(tmp_path, capsys):
    path, out = tmp_path / "evaluation.json", str(tmp_path / "out")
    path.write_text(json.dumps(evaluation()))
    report = ["irl", "report", "--out", out, "--theta", "us101"]
    simulated = ["--theta", "demonstrations", "--data", out]
    for arguments, message in (
        (["irl", "recover", "--data", "recordings", "--out", out], "true weights are known of simulated drivers only"),
        (["irl", "recover", "--data", "minari:ms-highway/absent-v0", "--out", out], "there is no data set"),
        ([*report, "--evaluation", str(tmp_path / "absent.json"), "--data", out], "cannot be read as an evaluation"),
        ([*report, "--evaluation", str(path), "--data", out], "is not a directory"),
        ([*report, "--evaluation", str(path), *simulated], "--theta demonstrations: this reward has no drivers"),
        (["irl", "evaluate", *simulated], "--theta demonstrations: this reward has no drivers"),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
