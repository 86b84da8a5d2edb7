"""Draw predicted drivers: errors, paths in examples, and feature counts."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter

from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.prediction import HORIZONS, MISS, Cases
from ms_highway.visualization.road import car_outline, draw_road

__all__ = ["PREDICTORS", "counts_figure", "errors_figure", "paths_figure"]

PREDICTORS = {
    "model": ("learned reward", "#1f5fbf", "o"),
    "constant_velocity": ("constant velocity", "#8a93a5", "s"),
    "idm": ("IDM", "#d9822b", "^"),
}
"""Label, colour and marker of each predictor."""

RECORDED = "#111318"
BEFORE, AFTER = 15.0, 25.0  # m of road drawn behind and ahead of where cars drive


def paths_figure(cases: Cases, paths: Mapping[str, Float[np.ndarray, "n 50 2"]], titles: Sequence[str]) -> Figure:
    """Draw predicted and recorded paths over the lanes, a row per case, seen from above; dots are a second apart.

    The driver's left is up. Cars are drawn at the start, the others as large as the driver, with grey paths.

    Args:
        cases: the cases to draw.
        paths: by predictor, see `PREDICTORS`.
        titles: of the cases.
    """
    recorded = np.asarray(cases.recorded)
    ends = np.concatenate([recorded[:, 1:, :1], *(path[..., :1] for path in paths.values())], axis=1)
    stretch = -BEFORE, float(np.nanmax(ends[..., 0] - recorded[:, :1, 0])) + AFTER
    across = float(np.ptp(cases.scenes.lanes, axis=1).max() + 2 * np.max(cases.scenes.lane_width))
    height = 10 * across / (stretch[1] - stretch[0]) + 0.6  # inches, at one scale along and across
    figure = Figure(figsize=(11, 0.6 + height * len(cases)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(len(cases), 1))
    for number, (axes, title) in enumerate(zip(panels, titles, strict=True)):
        own = {name: path[number] for name, path in paths.items()}
        _map(axes, cases, number, own, stretch)
        track = recorded[number]
        seen = np.isfinite(track).all(axis=-1)
        last = int(np.flatnonzero(seen)[-1])
        off = {name: float(np.linalg.norm(path[last - 1] - track[last, :2])) for name, path in own.items()}
        misses = ", ".join(f"{PREDICTORS[name][0]} {value:.1f} m" for name, value in off.items())
        speeds = f"{track[0, 3]:.1f} to {track[last, 3]:.1f} m/s"
        axes.set_title(f"{title}, {speeds}; off after {last / 10:g} s: {misses}", loc="left", fontsize="medium")
    panels[-1].set_xlabel("along the road [m]")
    handles = [Line2D([], [], color=RECORDED, marker="D", markersize=4, label="recorded")]
    handles += [
        Line2D([], [], color=PREDICTORS[name][1], marker=PREDICTORS[name][2], markersize=4, label=PREDICTORS[name][0])
        for name in paths
    ]
    handles.append(Line2D([], [], color="#c4c9d1", label="others, as recorded"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def _map(
    axes: Axes, cases: Cases, number: int, paths: Mapping[str, Float[np.ndarray, "50 2"]], stretch: tuple[float, float]
) -> None:
    """Draw one case on a stretch of road [m], measured from the driver."""
    lanes, width = np.unique(cases.scenes.lanes[number]), float(np.asarray(cases.scenes.lane_width)[number])
    car, track = np.asarray(cases.scenes.car_size[number]), np.asarray(cases.recorded)[number]
    origin, (low, high) = track[0, 0], stretch
    draw_road(axes, lanes, width, stretch)
    for other in np.flatnonzero(cases.present[number, 0]):
        there = cases.others[number, cases.present[number, :, other], other]
        if low - 5 < there[0, 0] - origin < high + 5:
            axes.plot(there[:, 0] - origin, there[:, 1], color="#c4c9d1", linewidth=1, zorder=2)
            axes.add_patch(
                car_outline(there[0] - [origin, 0, 0, 0], car, facecolor="#d9dce2", edgecolor="#8a93a5", zorder=3)
            )
    axes.add_patch(
        car_outline(track[0] - [origin, 0, 0, 0], car, facecolor="#ffffff", edgecolor=RECORDED, linewidth=1.4, zorder=3)
    )
    drawn = {"recorded": track[1:, :2], **paths}
    for order, (name, path) in enumerate(drawn.items()):
        color, marker = PREDICTORS[name][1:] if name in PREDICTORS else (RECORDED, "D")
        line = np.concatenate([track[:1, :2], path]) - [origin, 0.0]
        axes.plot(*line.T, color=color, linewidth=1.3, marker=marker, markersize=4, markevery=10, zorder=4 + order)
    axes.set_ylabel("to the\nright [m]")


def errors_figure(evaluation: Mapping[str, Any]) -> Figure:
    """Draw final displacement and share of misses against the horizon, for the model and its baselines.

    Args:
        evaluation: of `ms_highway.irl.evaluation`.
    """
    figure = Figure(figsize=(9, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, (label, color, marker) in PREDICTORS.items():
        for axes, kind in ((left, "fde"), (right, "miss")):
            values = {int(horizon): value for horizon, value in evaluation[name][kind].items()}
            seconds = sorted(values)
            axes.plot(seconds, [values[at] for at in seconds], marker=marker, color=color, label=label)
    left.set(ylabel="mean error at the horizon [m]")
    right.set(ylabel=f"share of cases off by more than {MISS:g} m")
    right.yaxis.set_major_formatter(PercentFormatter(1.0))
    for axes in (left, right):
        axes.set(xlabel="horizon [s]", xticks=range(1, max(HORIZONS) + 1))
        axes.set_ylim(bottom=0)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#eeeeee")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(f"{evaluation['windows']} stretches of {evaluation['tracks']} drivers")
    return figure


def counts_figure(learned: LearnedReward) -> Figure:
    """Draw mean sums of the features over a window: the drivers', and those expected under the reward."""
    human, model = learned.feature_counts["human"], learned.feature_counts["model"]
    names = list(human)
    figure = Figure(figsize=(8.5, 1.4 + 0.5 * len(names)), layout="constrained")
    axes = figure.subplots()
    for shift, label, counts, color in (
        (-0.2, "drivers", human, RECORDED),
        (0.2, "expected under the reward", model, PREDICTORS["model"][1]),
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
