"""Draw predicted drivers: errors, likelihood, calibration, paths in examples, and feature counts."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.errors import HORIZONS, LEVELS, MISS
from ms_highway.irl.moments import Moments
from ms_highway.irl.outlook import expected_path
from ms_highway.irl.predictors import PREDICTORS, Prediction
from ms_highway.visualization.road import car_outline, draw_road

__all__ = ["calibration_figure", "counts_figure", "errors_figure", "likelihood_figure", "paths_figure"]

STYLES = {
    "model": ("#1f5fbf", "o"),
    "constant_velocity": ("#8a93a5", "s"),
    "turn_and_accelerate": ("#5b8c5a", "v"),
    "idm": ("#d9822b", "^"),
    "fitted_idm": ("#b8433a", "D"),
    "lane_modes": ("#7d57a8", "P"),
}
"""Colour and marker of each predictor."""

DRAWN = ("model", "constant_velocity", "fitted_idm")  # of the predictors, in paths
RECORDED = "#111318"
BEFORE, AFTER = 15.0, 25.0  # m of road drawn behind and ahead of where cars drive
NEAR = 0.05  # of what is right, in calibrations
LIKELY = 0.05  # probability from which on a mode is drawn


def paths_figure(moments: Moments, predicted: Mapping[str, Prediction], examples: Mapping[str, int]) -> Figure:
    """Draw predicted and recorded paths over the lanes, a row per example, seen from above; dots are a second apart.

    The driver's left is up. Of the learned drivers, all modes of 5 % or more are drawn, bolder with their probability,
    of the others the expected path. Cars are drawn at the start; grey paths are those of the others, as recorded.

    Args:
        moments: in which the examples are.
        predicted: of the examples, in their order, by predictor.
        examples: number of each example among the predicted drivers, by title.
    """
    where = np.argwhere(np.asarray(moments.predicted))[list(examples.values())]
    recorded = moments.recorded[list(examples.values())]
    starts = np.asarray(moments.now)[where[:, 0], where[:, 1]]
    expected = {name: expected_path(predicted[name].modes) for name in DRAWN if name in predicted}
    ends = np.concatenate([recorded[..., 0], *(path[..., 0] for path in expected.values())], axis=1)
    stretch = -BEFORE, float(np.nanmax(ends - starts[:, :1])) + AFTER
    across = float(np.ptp(moments.lanes, axis=1).max() + 2 * np.max(moments.lane_width))
    height = 10 * across / (stretch[1] - stretch[0]) + 0.6  # inches, at one scale along and across
    figure = Figure(figsize=(11, 0.6 + height * len(examples)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(len(examples), 1))
    for number, (axes, title) in enumerate(zip(panels, examples, strict=True)):
        moment, car = map(int, where[number])
        _road(axes, moments, moment, car, stretch)
        own = {name: path[number] for name, path in expected.items()}
        _paths(axes, starts[number], recorded[number], own)
        if "model" in predicted:
            _modes(axes, starts[number], *(np.asarray(part)[number] for part in predicted["model"].modes))
        last = int(np.flatnonzero(np.isfinite(recorded[number, :, 0]))[-1])
        off = {name: float(np.linalg.norm(path[last] - recorded[number, last])) for name, path in own.items()}
        misses = ", ".join(f"{PREDICTORS[name]} {value:.1f} m" for name, value in off.items())
        axes.set_title(f"{title}, {starts[number, 3]:.1f} m/s; off after {(last + 1) / 10:g} s: {misses}", loc="left")
        axes.title.set_fontsize("medium")
    panels[-1].set_xlabel("along the road [m]")
    handles = [Line2D([], [], color=RECORDED, marker="D", markersize=4, label="recorded")]
    handles += [
        Line2D([], [], color=STYLES[name][0], marker=STYLES[name][1], markersize=4, label=PREDICTORS[name])
        for name in expected
    ]
    handles.append(Line2D([], [], color="#c4c9d1", label="others, as recorded"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _road(axes: Axes, moments: Moments, moment: int, car: int, stretch: tuple[float, float]) -> None:
    """Draw the road and all cars of a moment on a stretch of road [m], measured from a driver."""
    draw_road(axes, np.unique(moments.lanes[moment]), float(np.asarray(moments.lane_width)[moment]), stretch)
    now, sizes = np.asarray(moments.now)[moment], np.asarray(moments.sizes)[moment]
    origin = np.array([now[car, 0], 0.0, 0.0, 0.0])
    for other in np.flatnonzero(np.isfinite(now).all(axis=1)):
        state = now[other] - origin
        if stretch[0] - 5 < state[0] < stretch[1] + 5:
            there = np.concatenate([now[None, other], np.asarray(moments.future)[moment, :, other]]) - origin
            if other != car:
                axes.plot(*there[:, :2].T, color="#c4c9d1", linewidth=1, zorder=2)
            style = {"facecolor": "#ffffff", "edgecolor": RECORDED} if other == car else {"facecolor": "#d9dce2"}
            axes.add_patch(car_outline(state, sizes[other], zorder=3, **{"edgecolor": "#8a93a5", **style}))
    axes.set_ylabel("to the\nright [m]")


def _paths(
    axes: Axes,
    start: Float[np.ndarray, "4"],
    recorded: Float[np.ndarray, "50 2"],
    expected: Mapping[str, Float[np.ndarray, "50 2"]],
) -> None:
    """Draw a driver's recorded path and those that are expected, measured from where it is."""
    for order, (name, path) in enumerate({"recorded": recorded, **expected}.items()):
        color, marker = STYLES.get(name, (RECORDED, "D"))
        line = np.concatenate([start[None, :2], path]) - [start[0], 0.0]
        axes.plot(*line.T, color=color, linewidth=1.3, marker=marker, markersize=4, markevery=10, zorder=4 + order)


def _modes(
    axes: Axes,
    start: Float[np.ndarray, "4"],
    probability: Float[np.ndarray, "modes"],
    path: Float[np.ndarray, "modes 50 2"],
) -> None:
    """Draw the modes of the learned drivers that are likely enough."""
    for chance, mode in zip(probability, path, strict=True):
        if chance >= LIKELY:
            color = STYLES["model"][0]
            axes.plot(mode[:, 0] - start[0], mode[:, 1], color=color, linewidth=1 + 5 * chance, alpha=0.25, zorder=3)


def errors_figure(evaluation: Mapping[str, Any]) -> Figure:
    """Draw final displacement and share of misses against the horizon, for all predictors.

    Args:
        evaluation: of `ms_highway.irl.evaluation`.
    """
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, kind in ((left, "fde"), (right, "miss")):
        _against_horizon(axes, evaluation, kind)
        axes.set_ylim(bottom=0)
    most = max(evaluation["predictors"]["constant_velocity"]["fde"].values())  # beyond which is highway-env's IDM
    left.set(ylabel="mean error at the horizon [m]", ylim=(0, 1.15 * most))
    right.set(ylabel=f"share of drivers off by more than {MISS:g} m")
    right.yaxis.set_major_formatter(PercentFormatter(1.0))
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(f"{evaluation['windows']} predictions of {evaluation['tracks']} drivers")
    return figure


def likelihood_figure(evaluation: Mapping[str, Any]) -> Figure:
    """Draw the mean log density of recorded positions against the horizon, for all predictors."""
    figure = Figure(figsize=(6, 4.2), layout="constrained")
    axes = figure.subplots()
    _against_horizon(axes, evaluation, "log_p")
    axes.set_ylabel("mean log density of the recorded position [1/m²]")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def calibration_figure(evaluation: Mapping[str, Any]) -> Figure:
    """Draw how often drivers are in the predicted regions of 50, 90 and 99 %, against the horizon, a panel for each.

    The band is five points to each side of what is right.
    """
    figure = Figure(figsize=(11, 3.9), layout="constrained")
    panels = figure.subplots(1, len(LEVELS))
    for axes, level in zip(panels, LEVELS, strict=True):
        _against_horizon(axes, evaluation, f"inside {level}")
        axes.axhline(level / 100, color=RECORDED, linewidth=1, linestyle="--")
        axes.axhspan(level / 100 - NEAR, min(level / 100 + NEAR, 1.0), color="#f1f2f4", zorder=0)
        axes.set_title(f"region of {level} %")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    panels[0].set_ylabel("share of drivers in it")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _against_horizon(axes: Axes, evaluation: Mapping[str, Any], kind: str) -> None:
    for name, (color, marker) in STYLES.items():
        values = {int(horizon): value for horizon, value in evaluation["predictors"][name][kind].items()}
        seconds = sorted(values)
        axes.plot(seconds, [values[at] for at in seconds], marker=marker, color=color, label=PREDICTORS[name])
    axes.set(xlabel="horizon [s]", xticks=range(1, max(HORIZONS) + 1))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#eeeeee")


def counts_figure(learned: LearnedReward) -> Figure:
    """Draw mean sums of the features over a window: the drivers', and those expected under the reward."""
    human, model = learned.feature_counts["human"], learned.feature_counts["model"]
    names = list(human)
    figure = Figure(figsize=(8.5, 1.4 + 0.5 * len(names)), layout="constrained")
    axes = figure.subplots()
    for shift, label, counts, color in (
        (-0.2, "drivers", human, RECORDED),
        (0.2, "expected under the reward", model, STYLES["model"][0]),
    ):
        sizes = np.array([max(abs(human[name]), abs(model[name])) or 1.0 for name in names])
        values = np.array([counts[name] for name in names])
        bars = axes.barh(np.arange(len(names)) + shift, values / sizes, height=0.38, color=color, label=label)
        axes.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize="small")
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes.invert_yaxis()
    axes.margins(x=0.15)
    axes.set(xlabel="mean sum over a window, relative to the larger of the two; labels are the sums")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure
