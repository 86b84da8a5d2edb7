"""Draw predicted drivers: errors, likelihood, calibration, and paths."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.irl.evaluation import LEVELS, MISS, Evaluation
from ms_highway.irl.moments import HORIZONS, cut_moments
from ms_highway.irl.outlook import expected_path
from ms_highway.irl.predictors import PREDICTORS, prediction
from ms_highway.irl.recordings.recording import Recording

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
    "errors": {"fde": "mean error at the horizon [m]", "miss": f"share of drivers off by more than {MISS:g} m"},
    "likelihood": {"log_p": "mean log density of the recorded position [1/m²]"},
    "calibration": {f"inside {level}": f"share of drivers in the region of {level} %" for level in LEVELS},
}
"""What each figure of an evaluation shows, and its label."""


def evaluation_figures(evaluation: Evaluation) -> dict[str, Figure]:
    """Draw measures of all predictors against the horizon, a figure for each of `PANELS`.

    Calibration is how often drivers are in the predicted regions of 50, 90 and 99 %; the band is five points to each
    side of the right share.
    """
    figures = {name: _against_horizon(evaluation, labels) for name, labels in PANELS.items()}
    left, right = figures["errors"].axes
    left.set_ylim(0, 1.15 * max(evaluation.predictors["constant_velocity"]["fde"].values()))  # without IDM's
    right.set_ylim(bottom=0)
    figures["errors"].suptitle(f"{evaluation.windows} predictions of {evaluation.tracks} drivers")
    for axes, level in zip(figures["calibration"].axes, LEVELS, strict=True):
        axes.axhline(level / 100, color=RECORDED, linewidth=1, linestyle="--")
        axes.axhspan(level / 100 - NEAR, min(level / 100 + NEAR, 1.0), color="#f1f2f4", zorder=0)
    return figures


def _against_horizon(evaluation: Evaluation, labels: Mapping[str, str]) -> Figure:
    figure = Figure(figsize=(2.5 + 3 * len(labels), 4.2), layout="constrained")
    panels = figure.subplots(1, len(labels), squeeze=False)[0]
    for axes, (kind, label) in zip(panels, labels.items(), strict=True):
        for name, predictor in PREDICTORS.items():
            color, marker = STYLES[name]
            values = evaluation.predictors[name][kind]
            axes.plot(list(map(int, values)), list(values.values()), marker=marker, color=color, label=predictor)
        axes.set(xlabel="horizon [s]", ylabel=label, xticks=range(1, max(HORIZONS) + 1))
        if kind not in ("fde", "log_p"):
            axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#eeeeee")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def paths_figure(recordings: Sequence[Recording], drivers: LearnedDrivers) -> Figure:
    """Draw predicted and recorded paths at one moment, seen from above; marks are a second apart.

    It is the moment with most drivers that were recorded for the 3 s before and the 5 s after. Of the learned drivers,
    all modes of 5 % or more are drawn, bolder with their probability; of the others, the expected path.

    Raises:
        ValueError: if no driver was recorded for as long.
    """
    moments = cut_moments(recordings)
    whole = np.isfinite(np.concatenate([moments.past, moments.future], axis=1)).all(axis=(1, 3)) & moments.predicted
    most = int(whole.sum(axis=1).argmax())
    if not whole[most].any():
        raise ValueError("no driver was recorded for 8 s on end; there are no paths to be drawn")
    moment = replace(moments, predicted=whole).of(np.arange(len(moments)) == most)
    modes = {name: prediction(name, moment, drivers).modes for name in DRAWN}
    paths = {"recorded": moment.recorded, **{name: expected_path(found) for name, found in modes.items()}}
    start, lanes, width = moment.drivers(moment.now)[:, None, :2], np.unique(moment.lanes), float(moment.lane_width[0])
    figure = Figure(figsize=(11, 6), layout="constrained")
    axes = figure.subplots()
    for edge in (lanes[0] - width / 2, *(lanes + width / 2)):
        axes.axhline(edge, color="#b4b9c2", linewidth=0.8)
    for chances, ways in zip(*map(np.asarray, modes["model"]), strict=True):
        for chance, way in zip(chances, ways, strict=True):
            if chance >= LIKELY:
                axes.plot(*way.T, color=STYLES["model"][0], linewidth=1 + 5 * chance, alpha=0.25)
    for name, path in paths.items():
        color, marker = STYLES[name]
        lines = axes.plot(*np.concatenate([start, path], axis=1).T, color=color, marker=marker, markevery=10)
        for line in lines:
            line.set(linewidth=1.3, markersize=4)
        lines[0].set_label(PREDICTORS.get(name, name))
    axes.set(xlabel="along the road [m]", ylabel="to the right [m]", yticks=lanes.round(1))
    axes.invert_yaxis()  # the driver's left is up
    figure.legend(loc="outside lower center", ncols=len(paths), frameon=False)
    return figure
