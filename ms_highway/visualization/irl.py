"""Draw predicted drivers (errors, likelihood, calibration, paths); tabulate learned
rewards and evaluations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ms_highway.data.learned_drivers import LearnedDrivers
from ms_highway.data.learned_reward import LearnedReward, log_normal_interval
from ms_highway.irl.evaluation import LEVELS, MISS, Evaluation
from ms_highway.irl.horizons import HORIZONS
from ms_highway.irl.mixture import expected_path
from ms_highway.irl.prediction import PREDICTORS, predict_with
from ms_highway.irl.recording import Recording
from ms_highway.irl.snapshots import cut_snapshots
from ms_highway.visualization.style import legend, styled
from ms_highway.visualization.tables import grid, texts

STYLES = {
    "model": ("#1f5fbf", "o"),
    "constant_velocity": ("#8a93a5", "s"),
    "idm": ("#d9822b", "^"),
    "fitted_idm": ("#b8433a", "D"),
    "recorded": ("#111318", "D"),
}
"""Colour and marker of each predictor, and of the recorded path."""

RECORDED = STYLES["recorded"][0]
DRAWN = ("model", "constant_velocity", "fitted_idm")  # of the predictors, in paths
NEAR = 0.05  # of the right share, in calibrations
LIKELY = 0.05  # probability from which on a mode is drawn

PANELS = {
    "errors": {
        "fde": "mean error at the horizon [m]",
        "miss": f"share of drivers off by more than {MISS:g} m",
    },
    "likelihood": {"log_p": "mean log density of the recorded position [1/m²]"},
    "calibration": {
        f"inside {level}": f"share of drivers in the region of {level} %"
        for level in LEVELS
    },
}
"""Metrics in each figure of an evaluation, and their labels."""

METRICS = {
    "predicted by": "{label}",
    "after": "{horizon} s",
    "FDE": "{fde:.2f}",
    "RMSE": "{rmse:.2f}",
    "miss": "{miss:.0%}",
    "log p": "{log_p:.2f}",
    **{f"in {level} %": f"{{inside {level}:.1%}}" for level in LEVELS},
}
REGIMES = {"what drivers did": "{regime}", "predictions": "{windows:.0f}"}
REGIMES |= {label: f"{{{name}:.2f}}" for name, label in PREDICTORS.items()}
LEARNED = {
    "weight": "{weight}",
    "value": "{value:.4g}",
    "90 % interval": "{interval}",
    "true": "{true:g}",
    "feature of drivers": "{drivers:.3g}",
    "feature expected": "{expected:.3g}",
}
"""Columns of tables, see `ms_highway.visualization.tables.texts`."""


def evaluation_figures(evaluation: Evaluation) -> dict[str, Figure]:
    """Draw metrics of all predictors against the horizon, a figure for each of
    `PANELS`, see `metrics_figure`.
    """
    return {name: metrics_figure(evaluation, name) for name in PANELS}


@styled
def metrics_figure(evaluation: Evaluation, name: str) -> Figure:
    """Draw metrics of all predictors against the horizon.

    Calibration is the share of drivers in the predicted regions of 50, 90 and 99 %; the
    band is five percentage points to each side of the right share.

    Args:
        evaluation: the metrics.
        name: of the figure, one of `PANELS`.
    """
    labels = PANELS[name]
    figure = Figure(figsize=(2.5 + 3 * len(labels), 4.2))
    panels = figure.subplots(1, len(labels), squeeze=False)[0]
    for axes, (kind, label) in zip(panels, labels.items(), strict=True):
        for predictor, title in PREDICTORS.items():
            color, marker = STYLES[predictor]
            values = evaluation.predictors[predictor][kind]
            axes.plot(
                list(map(int, values)),
                list(values.values()),
                marker=marker,
                color=color,
                label=title,
            )
        axes.set(
            xlabel="horizon [s]",
            ylabel=label,
            xticks=range(1, max(HORIZONS.seconds) + 1),
        )
        axes.grid(axis="y")
        if kind.startswith("inside"):
            share = int(kind.split()[1]) / 100
            axes.axhline(share, color=RECORDED, linewidth=1, linestyle="--")
            axes.axhspan(
                share - NEAR, min(share + NEAR, 1.0), color="#f1f2f4", zorder=0
            )
        if kind not in ("fde", "log_p"):
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    legend(figure, *panels[0].get_legend_handles_labels())
    if name == "errors":
        left, right = panels
        kept = evaluation.predictors["constant_velocity"]["fde"]
        left.set_ylim(0, 1.15 * max(kept.values()))  # without IDM's
        right.set_ylim(bottom=0)
        figure.suptitle(
            f"{evaluation.windows} predictions of {evaluation.tracks} drivers"
        )
    return figure


@styled
def paths_figure(recordings: Sequence[Recording], drivers: LearnedDrivers) -> Figure:
    """Draw predicted and recorded paths at one moment, seen from above; marks are a
    second apart.

    The moment is the one with most drivers that were recorded for 3 s before and 5 s
    after. For the learned drivers, modes of 5 % or more are drawn, with widths by their
    probability, and for all predictors the expected path.

    Raises:
        ValueError: if no driver was recorded for so long.
    """
    snapshots = cut_snapshots(recordings)
    states = np.concatenate([snapshots.past, snapshots.future], axis=1)
    whole = np.isfinite(states).all(axis=(1, 3)) & snapshots.predicted
    most = int(whole.sum(axis=1).argmax())
    if not whole[most].any():
        raise ValueError(
            "no driver was recorded for 8 s on end; there are no paths to be drawn"
        )
    one = replace(snapshots, predicted=whole).of(np.arange(len(snapshots)) == most)
    start = one.drivers(one.now)[:, None, :2]
    lanes = np.unique(one.lanes)
    width = float(one.lane_width[0])
    figure = Figure(figsize=(11, 6))
    axes = figure.subplots()
    paths = {"recorded": one.recorded}
    for edge in (lanes[0] - width / 2, *(lanes + width / 2)):
        axes.axhline(edge, color="#b4b9c2", linewidth=0.8)
    for name in DRAWN:
        modes = predict_with(name, one, drivers).modes
        paths[name] = expected_path(modes)
        for chance, way in (
            zip(*map(np.concatenate, modes), strict=True) if name == "model" else ()
        ):
            if chance >= LIKELY:
                axes.plot(
                    *way.T, color=STYLES[name][0], linewidth=1 + 5 * chance, alpha=0.25
                )
    for name, path in paths.items():
        color, marker = STYLES[name]
        whole_paths = np.concatenate([start, path], axis=1).T
        lines = axes.plot(
            *whole_paths,
            color=color,
            marker=marker,
            markevery=10,
            linewidth=1.3,
            markersize=4,
        )
        lines[0].set_label(PREDICTORS.get(name, name))
    axes.set(
        xlabel="along the road [m]", ylabel="to the right [m]", yticks=lanes.round(1)
    )
    axes.invert_yaxis()  # the driver's left is up
    legend(figure, *axes.get_legend_handles_labels())
    return figure


def learned_tables(
    learned: LearnedReward, true: Mapping[str, float] | None = None
) -> list[pd.DataFrame]:
    """Tabulate a learned reward, and learned drivers if there are any, with 90 %
    intervals.

    The last columns are mean sums of the features over a segment: of drivers, and
    expected under the reward.

    Args:
        learned: the reward.
        true: the drivers' true weights by name, if they are known, for a further
            column.
    """
    values = {**learned.weights, "temperature": learned.temperature}
    values |= {"tails": learned.tails} if learned.tails else {}
    counts = learned.feature_counts
    true = true or {}
    rows = []
    for name, value in values.items():
        row = {"weight": name, "value": value, "true": true.get(name)}
        row |= {
            "drivers": counts["human"].get(name),
            "expected": counts["model"].get(name),
        }
        if name in learned.weights:
            row["interval"] = (
                _ends(learned.interval(name)) if name in learned.learned else "given"
            )
        rows.append(row)
    found = [grid(f"learned from {learned.windows} segments", texts(LEARNED, rows))]
    return [*found, _drivers_table(learned.drivers)] if learned.drivers else found


def _ends(interval: Any) -> str:
    return "{:.3g}, {:.3g}".format(*interval)


def _drivers_table(drivers: LearnedDrivers) -> pd.DataFrame:
    """Tabulate the numbers learned seconds ahead, with 90 % intervals where there are
    any.
    """
    prior = drivers.prior
    numbers = {
        **drivers.weights,
        "typical headway": prior.median[1],
        **dict(
            zip(
                ("desired speeds", "headways", "patiences"),
                prior.deviations,
                strict=True,
            )
        ),
        "noise": prior.noise,
        **{
            f"{name} while changing lanes": value
            for name, value in drivers.changing.items()
        },
    }
    rows = []
    for name, value in numbers.items():
        spread = drivers.deviations.get(name, np.nan)
        ends = (
            _ends(log_normal_interval(value, spread))
            if np.isfinite(spread)
            else "given"
        )
        rows.append(
            {"weight or trait": name, "value": f"{value:.3g}", "90 % interval": ends}
        )
    return grid("learned seconds ahead; factors while changing lanes", rows)


def evaluation_tables(evaluation: Evaluation) -> list[pd.DataFrame]:
    """Tabulate an evaluation: all metrics by horizon, then mean errors and log
    densities by driving regime.
    """
    rows = []
    for horizon, (name, label) in product(
        map(str, HORIZONS.seconds), PREDICTORS.items()
    ):
        found = {
            kind: values[horizon]
            for kind, values in evaluation.predictors[name].items()
            if horizon in values
        }
        if found:
            rows.append({"label": label, "horizon": horizon, **found})
    tables = [
        grid(
            f"{evaluation.windows} predictions of {evaluation.tracks} drivers",
            texts(METRICS, rows),
            2,
        )
    ]
    regimes = (("distance", "mean error, m"), ("log_p", "mean log density"))
    for (kind, what), horizon in product(regimes, ("3", "5")):
        rows = []
        for regime, row in evaluation.situations[kind].items():
            errors = {name: row[name].get(horizon) for name in PREDICTORS}
            rows.append(
                {"regime": regime, "windows": row["windows"][horizon], **errors}
            )
        tables += (
            [grid(f"{what}, after {horizon} s", texts(REGIMES, rows))] if rows else []
        )
    return tables
