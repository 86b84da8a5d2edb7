"""Draw and tabulate predictions of drivers; tabulate learned rewards."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ms_highway.data.learned_drivers import LearnedDrivers
from ms_highway.data.learned_reward import LearnedReward, log_normal_interval
from ms_highway.irl.evaluation import LEVELS, MISS, Evaluation
from ms_highway.irl.horizons import HORIZONS
from ms_highway.irl.mixture import expected_path
from ms_highway.irl.prediction import PREDICTORS, predict_with
from ms_highway.irl.recording import Recording
from ms_highway.irl.snapshots import Snapshots, cut_snapshots
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


def evaluation_figures(evaluation: Evaluation) -> dict[str, Figure]:
    """Draw the figures of `PANELS`, see `metrics_figure`."""
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
            horizons = [int(horizon) for horizon in values]
            means = list(values.values())
            axes.plot(horizons, means, marker=marker, color=color, label=title)
        ticks = range(1, max(HORIZONS.seconds) + 1)
        axes.set(xlabel="horizon [s]", ylabel=label, xticks=ticks)
        axes.grid(axis="y")
        if kind.startswith("inside"):
            share = int(kind.split()[1]) / 100
            low = share - 0.05
            high = min(share + 0.05, 1.0)
            recorded, _ = STYLES["recorded"]
            axes.axhline(share, color=recorded, linewidth=1, linestyle="--")
            axes.axhspan(low, high, color="#f1f2f4", zorder=0)
        if kind not in ("fde", "log_p"):
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    legend(figure, *panels[0].get_legend_handles_labels())
    if name == "errors":
        left, right = panels
        # The highest are those of constant velocity, but for IDM's, which are cut off.
        errors = evaluation.predictors["constant_velocity"]["fde"]
        left.set_ylim(0, 1.15 * max(errors.values()))
        right.set_ylim(bottom=0)
        figure.suptitle(
            f"{evaluation.windows} predictions of {evaluation.tracks} drivers"
        )
    return figure


@styled
def paths_figure(recordings: Sequence[Recording], drivers: LearnedDrivers) -> Figure:
    """Draw predicted and recorded paths at one moment, seen from above.

    Marks are a second apart. The moment is the one with most drivers that were recorded
    for 3 s before and 5 s after. For the learned drivers, modes of 5 % or more are
    drawn, with widths by their probability, and for all predictors the expected path.

    Raises:
        ValueError: if no driver was recorded for so long.
    """
    one = _fullest_moment(cut_snapshots(recordings))
    figure = Figure(figsize=(11, 6))
    axes = figure.subplots()

    # The edges of the lanes.
    lanes = np.unique(one.lanes)
    width = float(one.lane_width[0])
    for edge in (lanes[0] - width / 2, *(lanes + width / 2)):
        axes.axhline(edge, color="#b4b9c2", linewidth=0.8)

    # Modes of the learned drivers, and expected paths of all predictors.
    least_probability = 0.05
    paths = {"recorded": one.recorded}
    for name in ("model", "constant_velocity", "fitted_idm"):
        modes = predict_with(name, one, drivers).modes
        paths[name] = expected_path(modes)
        if name != "model":
            continue
        color, _ = STYLES[name]
        for probability, path in zip(*map(np.concatenate, modes), strict=True):
            if probability >= least_probability:
                line_width = 1 + 5 * probability
                axes.plot(*path.T, color=color, linewidth=line_width, alpha=0.25)

    start = one.drivers(one.now)[:, None, :2]
    for name, path in paths.items():
        color, marker = STYLES[name]
        from_start = np.concatenate([start, path], axis=1)  # [drivers, steps, 2]
        lines = axes.plot(
            *from_start.T,
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
    # The driver's left is up.
    axes.invert_yaxis()
    legend(figure, *axes.get_legend_handles_labels())
    return figure


def _fullest_moment(snapshots: Snapshots) -> Snapshots:
    """Return the snapshot with most drivers that were recorded in all of its steps.

    Only these drivers are predicted.

    Raises:
        ValueError: if there is none.
    """
    states = np.concatenate([snapshots.past, snapshots.future], axis=1)
    recorded = np.isfinite(states).all(axis=(1, 3)) & snapshots.predicted
    fullest = int(recorded.sum(axis=1).argmax())
    if not recorded[fullest].any():
        raise ValueError(
            "no driver was recorded for 8 s on end; there are no paths to be drawn"
        )
    chosen = np.arange(len(snapshots)) == fullest
    return replace(snapshots, predicted=recorded).of(chosen)


def learned_tables(
    learned: LearnedReward,
    true: Mapping[str, float] | None = None,
) -> list[pd.DataFrame]:
    """Tabulate a learned reward and, if there are any, learned drivers.

    Tables have 90 % intervals. The last columns are mean sums of the features over a
    segment: of drivers, and expected under the reward.

    Args:
        learned: the reward.
        true: the drivers' true weights by name, if they are known, for a further
            column.
    """
    columns = {
        "weight": "{weight}",
        "value": "{value:.4g}",
        "90 % interval": "{interval}",
        "true": "{true:g}",
        "feature of drivers": "{drivers:.3g}",
        "feature expected": "{expected:.3g}",
    }
    values = {**learned.weights, "temperature": learned.temperature}
    if learned.tails:
        values["tails"] = learned.tails
    counts = learned.feature_counts
    rows = []
    for name, value in values.items():
        row = {
            "weight": name,
            "value": value,
            "true": (true or {}).get(name),
            "drivers": counts["human"].get(name),
            "expected": counts["model"].get(name),
        }
        if name in learned.weights:
            is_learned = name in learned.learned
            ends = _ends(learned.interval(name)) if is_learned else "given"
            row["interval"] = ends
        rows.append(row)
    tables = [grid(f"learned from {learned.windows} segments", texts(columns, rows))]
    if learned.drivers:
        tables.append(_drivers_table(learned.drivers))
    return tables


def _ends(interval: Float[np.ndarray, "2"]) -> str:
    """Return the ends of an interval as text."""
    low, high = interval
    return f"{low:.3g}, {high:.3g}"


def _drivers_table(drivers: LearnedDrivers) -> pd.DataFrame:
    """Tabulate the numbers learned seconds ahead, with 90 % intervals if known."""
    prior = drivers.prior
    desired_speeds, headways, patiences = prior.deviations
    numbers = {
        **drivers.weights,
        "typical headway": prior.median[1],
        "desired speeds": desired_speeds,
        "headways": headways,
        "patiences": patiences,
        "noise": prior.noise,
    }
    for name, value in drivers.changing.items():
        numbers[f"{name} while changing lanes"] = value
    rows = []
    for name, value in numbers.items():
        spread = drivers.deviations.get(name, np.nan)
        ends = "given"
        if np.isfinite(spread):
            ends = _ends(log_normal_interval(value, spread))
        row = {"weight or trait": name, "value": f"{value:.3g}", "90 % interval": ends}
        rows.append(row)
    return grid("learned seconds ahead; factors while changing lanes", rows)


def evaluation_tables(evaluation: Evaluation) -> list[pd.DataFrame]:
    """Tabulate an evaluation.

    The first table has all metrics by horizon; the others have mean errors and log
    densities by driving regime.
    """
    columns = {
        "predicted by": "{label}",
        "after": "{horizon} s",
        "FDE": "{fde:.2f}",
        "RMSE": "{rmse:.2f}",
        "miss": "{miss:.0%}",
        "log p": "{log_p:.2f}",
        **{f"in {level} %": f"{{inside {level}:.1%}}" for level in LEVELS},
    }
    rows = []
    horizons = [str(seconds) for seconds in HORIZONS.seconds]
    for horizon, (name, label) in product(horizons, PREDICTORS.items()):
        metrics = {
            kind: values[horizon]
            for kind, values in evaluation.predictors[name].items()
            if horizon in values
        }
        if metrics:
            rows.append({"label": label, "horizon": horizon, **metrics})
    title = f"{evaluation.windows} predictions of {evaluation.tracks} drivers"
    tables = [grid(title, texts(columns, rows), 2)]

    columns = {"what drivers did": "{regime}", "predictions": "{windows:.0f}"}
    for name, label in PREDICTORS.items():
        columns[label] = f"{{{name}:.2f}}"
    regimes = (("distance", "mean error, m"), ("log_p", "mean log density"))
    for (kind, what), horizon in product(regimes, ("3", "5")):
        rows = []
        for regime, own in evaluation.situations[kind].items():
            row = {"regime": regime, "windows": own["windows"][horizon]}
            for name in PREDICTORS:
                row[name] = own[name].get(horizon)
            rows.append(row)
        if rows:
            tables.append(grid(f"{what}, after {horizon} s", texts(columns, rows)))
    return tables
