"""Draw predicted drivers: errors, likelihood, calibration, paths in examples, and feature counts."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import PercentFormatter

from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.arrays import Steps
from ms_highway.irl.evaluation import LEVELS, MISS, Evaluation
from ms_highway.irl.moments import HORIZONS, STEPS, Moments, cut_moments
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

RECORDED, OTHERS = STYLES["recorded"][0], "#c4c9d1"
DRAWN = ("model", "constant_velocity", "fitted_idm")  # of the predictors, in paths
BEFORE, AFTER = 15.0, 25.0  # m of road drawn behind and ahead of where cars drive
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


def examples(moments: Moments, off: Steps) -> dict[str, int]:
    """Choose example drivers, by what is special about them; each was recorded for the whole 5 s.

    The typical one has the median error of constant velocity. None is chosen by the model's error.

    Args:
        moments: of the drivers.
        off: distance between each driver and its prediction at constant velocity [m].

    Returns:
        The number of each among the predicted drivers.

    Raises:
        ValueError: if no driver was recorded for 5 s.
    """
    recorded, start = moments.tracks(moments.future), moments.drivers(moments.now)
    whole = np.flatnonzero(np.isfinite(recorded).all(axis=(1, 2)))
    if not len(whole):
        raise ValueError(f"no driver was recorded for {STEPS / 10:g} s on end; there is no example to be drawn")
    faster = recorded[whole, -1, 3] - start[whole, 3]
    kinds = {
        "a typical case": np.abs(off[whole, -1] - np.median(off[whole, -1])),
        "the strongest braking": faster,
        "the strongest acceleration": -faster,
        "the largest lateral motion": -np.abs(recorded[whole, -1, 1] - start[whole, 1]),
    }
    chosen: dict[str, int] = {}
    for kind, order in kinds.items():
        rest = [place for place in whole[np.argsort(order)].tolist() if place not in chosen.values()]
        chosen |= {kind: rest[0]} if rest else {}
    return chosen


def paths_figure(recordings: Sequence[Recording], drivers: LearnedDrivers) -> Figure:
    """Draw predicted and recorded paths of `examples` over the lanes, a row for each; dots are a second apart.

    Seen from above, the driver's left is up. Of the learned drivers, all modes of 5 % or more are drawn, bolder with
    their probability, of the others the expected path. Cars are drawn at the start; grey paths are those of the others,
    as recorded.
    """
    moments = cut_moments(recordings)
    modes = {name: prediction(name, moments, drivers).modes for name in DRAWN}
    paths = {"recorded": moments.recorded, **{name: expected_path(found) for name, found in modes.items()}}
    off = {name: np.linalg.norm(path - moments.recorded, axis=-1) for name, path in paths.items()}
    chosen, starts = examples(moments, off["constant_velocity"]), moments.drivers(moments.now)
    numbers = list(chosen.values())
    farthest = max(np.max(path[numbers, :, 0] - starts[numbers, :1]) for path in paths.values())
    across = float(np.ptp(moments.lanes, axis=1).max() + 2 * np.max(moments.lane_width))
    height = 10 * across / (BEFORE + farthest + AFTER) + 0.6  # inches, at one scale along and across
    figure = Figure(figsize=(11, 0.6 + height * len(chosen)), layout="constrained")
    panels = figure.subplots(len(chosen), squeeze=False)[:, 0]
    for axes, (title, number) in zip(panels, chosen.items(), strict=True):
        _draw_moment(axes, moments, number, farthest)
        origin = starts[number, :2] * [1, 0]
        for name, path in paths.items():
            color, marker = STYLES[name]
            line = np.concatenate([starts[number, None, :2], path[number]]) - origin
            axes.plot(*line.T, color=color, linewidth=1.3, marker=marker, markersize=4, markevery=10, zorder=4)
        for chance, mode in zip(*(np.asarray(part)[number] for part in modes["model"]), strict=True):
            if chance >= LIKELY:
                style = {"color": STYLES["model"][0], "linewidth": 1 + 5 * chance, "alpha": 0.25, "zorder": 3}
                axes.plot(*(mode - origin).T, **style)
        misses = ", ".join(f"{PREDICTORS[name]} {off[name][number, -1]:.1f} m" for name in DRAWN)
        text = f"{title}, {starts[number, 3]:.1f} m/s; off after {STEPS / 10:g} s: {misses}"
        axes.set_title(text, loc="left", fontsize="medium")
    panels[-1].set_xlabel("along the road [m]")
    handles = [
        Line2D([], [], color=STYLES[name][0], marker=STYLES[name][1], markersize=4, label=PREDICTORS.get(name, name))
        for name in paths
    ]
    handles.append(Line2D([], [], color=OTHERS, label="others, as recorded"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _draw_moment(axes: Axes, moments: Moments, number: int, farthest: float) -> None:
    """Draw the lanes and all cars at the moment of a predicted driver, with x measured from that driver."""
    moment, car = np.argwhere(moments.predicted)[number]
    now, sizes, lanes = moments.now[moment], moments.sizes[moment], np.unique(moments.lanes[moment])
    origin, half = now[car, :2] * [1, 0], float(moments.lane_width[moment]) / 2
    left, right = lanes[0] - half, lanes[-1] + half
    axes.axhspan(left, right, color="#f1f2f4", zorder=0)
    for edge in (left, right):
        axes.axhline(edge, color="#555b66", linewidth=1.2, zorder=1)
    for marking in (lanes[1:] + lanes[:-1]) / 2:
        axes.axhline(marking, color="#b4b9c2", linewidth=0.8, linestyle=(0, (8, 8)), zorder=1)
    axes.set(xlim=(-BEFORE, farthest + AFTER), ylim=(right + half, left - half), aspect="equal")
    axes.set_yticks(lanes, [f"{round(y, 1) + 0.0:.1f}" for y in lanes], fontsize="x-small")
    axes.set_ylabel("to the\nright [m]")
    for other in np.flatnonzero(np.isfinite(now).all(axis=1)):
        position = now[other, :2] - origin
        if not -BEFORE - 5 < position[0] < farthest + AFTER + 5:
            continue
        if other != car:
            axes.plot(*(moments.future[moment, :, other, :2] - origin).T, color=OTHERS, linewidth=1, zorder=2)
        edge, face = (RECORDED, "#ffffff") if other == car else ("#8a93a5", "#d9dce2")
        style = {"angle": np.degrees(now[other, 2]), "rotation_point": "center", "edgecolor": edge, "facecolor": face}
        axes.add_patch(Rectangle(position - sizes[other] / 2, *sizes[other], zorder=3, **style))


def counts_figure(learned: LearnedReward) -> Figure:
    """Draw mean sums of the features over a window: the drivers', and those expected under the reward."""
    names = list(learned.feature_counts["human"])
    human, model = (np.array([learned.feature_counts[side][name] for name in names]) for side in ("human", "model"))
    sizes, places = np.maximum(np.abs(human), np.abs(model)), np.arange(len(names))
    figure = Figure(figsize=(8.5, 1.4 + 0.5 * len(names)), layout="constrained")
    axes = figure.subplots()
    for shift, label, values, color in (
        (-0.2, "drivers", human, RECORDED),
        (0.2, "expected under the reward", model, STYLES["model"][0]),
    ):
        shares = values / np.where(sizes == 0, 1.0, sizes)
        bars = axes.barh(places + shift, shares, height=0.38, color=color, label=label)
        axes.bar_label(bars, [f"{value:.3g}" for value in values], padding=3, fontsize="small")
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set_yticks(places, [name.replace("_", " ") for name in names])
    axes.invert_yaxis()
    axes.margins(x=0.15)
    axes.set(xlabel="mean sum over a window, relative to the larger of the two; labels are the sums")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure
