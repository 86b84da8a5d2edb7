"""Tables and figures of what was learned from driving; they show data, and learn nothing themselves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogFormatter, NullFormatter, NullLocator, PercentFormatter, StrMethodFormatter
from rich.box import SIMPLE
from rich.table import Table

from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.prediction import HORIZONS, MISS, STEPS, Cases, constant_velocity
from ms_highway.runtime.files import read_json
from ms_highway.visualization.road import car_outline, draw_road

__all__ = [
    "counts_figure",
    "errors_figure",
    "evaluation_table",
    "examples",
    "learned_table",
    "likelihood_figure",
    "load_evaluation",
    "paths_figure",
    "recovery_table",
    "situations_table",
    "weights_figure",
]

PREDICTORS = {
    "model": ("learned reward", "#1f5fbf", "o"),
    "constant_velocity": ("constant velocity", "#8a93a5", "s"),
    "idm": ("IDM", "#d9822b", "^"),
}
"""Who predicts, with the label, colour and marker of each."""

RECORDED = "#111318"
CLOSE = 1.25  # factor within which a weight counts as recovered, and which is shaded
NUMBERS = ("#a9c8ee", "#6c9fdc", "#3371c0", "#12427f")  # colours of numbers of demonstrations, few to many
RESOLUTION = 1e-5  # of regrets, which are small differences in float32
UNTOLD = "#a0a0a0"
TICKS = np.array([n * 10.0**power for power in range(-9, 10) for n in (1, 2, 5)])
BEFORE, AFTER = 15.0, 25.0  # m of road that are drawn behind and before where cars drive


def weights_figure(rows: pd.DataFrame) -> Figure:
    """How near learned weights are to the true ones, with 90 % intervals; one panel per demonstrator.

    Args:
        rows: of `ms_highway.irl.recovery.recover`, with a column ``driver``. Weights that are not identifiable are
            hollow.
    """
    drivers, weights = list(dict.fromkeys(rows["driver"])), list(dict.fromkeys(rows["weight"]))
    numbers = sorted(rows["demonstrations"].unique())
    colors = _ramp(len(numbers))
    figure = Figure(figsize=(max(4.2 * len(drivers), 8.5), 4.6), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(drivers)))
    for axes, driver in zip(panels, drivers, strict=True):
        own = rows[rows["driver"] == driver]
        axes.axhspan(1 / CLOSE, CLOSE, color="#cfe8cf", zorder=0)
        axes.axhline(1, color="#4a8f4a", linewidth=0.8, zorder=0)
        for place, (number, color) in enumerate(zip(numbers, colors, strict=True)):
            some = own[own["demonstrations"] == number].set_index("weight").reindex(weights)
            x = np.arange(len(weights)) + 0.7 * ((place + 0.5) / len(numbers) - 0.5)
            middle, low, high = (np.asarray(some[end] / some["true"]) for end in ("learned", "low", "high"))
            told = some["identifiable"].fillna(False).astype(bool).to_numpy()
            for chosen, paint, face in ((told, color, color), (~told, UNTOLD, "white")):
                errors = np.stack([middle - low, high - middle])[:, chosen]
                axes.errorbar(
                    x[chosen], middle[chosen], errors, fmt="o", color=paint, mfc=face, markersize=5, capsize=2
                )
        ratios = own["learned"] / own["true"]
        clear = own[own["identifiable"].astype(bool)]
        ends = np.concatenate([[1 / 2, 2], ratios, clear["low"] / clear["true"], clear["high"] / clear["true"]])
        axes.set_yscale("log")
        axes.set(ylim=(ends.min() / 1.3, ends.max() * 1.3), xlim=(-0.5, len(weights) - 0.5), title=str(driver))
        axes.set_xticks(range(len(weights)), [name.replace("_", "\n") for name in weights])
        _plain_ticks(axes)
        for edge in np.arange(len(weights) - 1) + 0.5:
            axes.axvline(edge, color="#dddddd", linewidth=0.8, zorder=0)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("learned / true weight")
    handles: list[Any] = [
        Line2D([], [], marker="o", color=color, label=f"{number}")
        for number, color in zip(numbers, colors, strict=True)
    ]
    handles.append(Line2D([], [], marker="o", color=UNTOLD, mfc="white", label="not identifiable"))
    handles.append(Patch(color="#cfe8cf", label=f"within a factor of {CLOSE:g}"))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles),
        frameon=False,
        title="demonstrations; bars are 90 % intervals",
    )
    return figure


def likelihood_figure(rows: pd.DataFrame) -> Figure:
    """What learned weights are worth on held-out demonstrations, against the number of demonstrations.

    Above, the log-likelihood, dashed that of the true weights; below, the regret of planning, of which float32 tells
    no less than 1e-5. A column per driver.
    """
    drivers = list(dict.fromkeys(rows["driver"]))
    figure = Figure(figsize=(max(4.0 * len(drivers), 5), 5.4), layout="constrained")
    panels = figure.subplots(2, len(drivers), sharex=True, squeeze=False)
    for (upper, lower), driver in zip(panels.T, drivers, strict=True):
        own = rows[rows["driver"] == driver].drop_duplicates("demonstrations").sort_values("demonstrations")
        upper.plot(own["demonstrations"], own["log_likelihood"], "o-", color=NUMBERS[-1], label="learned weights")
        upper.axhline(
            own["log_likelihood_true"].iloc[0], color="#4a8f4a", linestyle="--", label="true weights, best temperature"
        )
        lower.plot(own["demonstrations"], 100 * own["regret"].clip(lower=RESOLUTION), "o-", color=NUMBERS[-1])
        lower.set_yscale("log")
        lower.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        lower.yaxis.set_minor_formatter(LogFormatter())  # which labels where there is no decade to label
        upper.set_title(str(driver))
        upper.margins(y=0.15)
        lower.margins(y=0.15)
        lower.set_xscale("log")
        lower.set_xticks(own["demonstrations"], [f"{number}" for number in own["demonstrations"]])
        lower.xaxis.set_minor_locator(NullLocator())
        lower.set_xlabel("demonstrations")
        upper.ticklabel_format(axis="y", useOffset=False)
        for axes in (upper, lower):
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(axis="y", color="#eeeeee")
    panels[0, 0].set_ylabel("held-out log-likelihood\nper window [nat]")
    panels[1, 0].set_ylabel("regret of planning\n[% of what planning gains]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


def examples(cases: Cases) -> dict[str, int]:
    """A few cases worth a look, by what is special about them; each was recorded for the whole 5 s.

    The typical one is that with the median error of keeping the velocity. None is chosen by how the model does.

    Raises:
        ValueError: if nobody was recorded for 5 s.
    """
    recorded = np.asarray(cases.recorded)
    whole = np.flatnonzero(np.isfinite(recorded).all(axis=(1, 2)))
    if not len(whole):
        raise ValueError(f"no driver was recorded for {STEPS / 10:g} s on end; there is no example to be drawn")
    tracks = recorded[whole]
    end = np.linalg.norm(constant_velocity(cases)[whole, -1] - tracks[:, -1, :2], axis=-1)
    faster = tracks[:, -1, 3] - tracks[:, 0, 3]
    kinds = {
        "a typical case": np.abs(end - np.median(end)),
        "the strongest braking": faster,
        "the strongest acceleration": -faster,
        "the largest lateral motion": -np.abs(tracks[:, -1, 1] - tracks[:, 0, 1]),
    }
    chosen: dict[str, int] = {}
    for kind, order in kinds.items():
        rest = [int(whole[place]) for place in np.argsort(order) if int(whole[place]) not in chosen.values()]
        if rest:
            chosen[kind] = rest[0]
    return chosen


def paths_figure(cases: Cases, paths: Mapping[str, Float[np.ndarray, "n 50 2"]], titles: Sequence[str]) -> Figure:
    """Predicted and recorded paths over the lanes, a row per case, seen from above; dots are a second apart.

    Lane coordinates point to the right, so that the driver's left is up. Cars stand where they are at the start, the
    others as large as the driver, and the others' paths are grey.

    Args:
        cases: those to be drawn, which `Cases.of` chooses.
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
    """One case, along a stretch of road that is measured from the driver."""
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
    """Final displacement and share of misses against the horizon, for the model and its baselines.

    Args:
        evaluation: as `load_evaluation` reads it.
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
    """Mean sums of the features over a window: the drivers', and those expected under the reward."""
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


def learned_table(learned: LearnedReward, true: Mapping[str, float] | None = None) -> Table:
    """A learned reward, with the 90 % intervals of its weights.

    Args:
        learned: the reward.
        true: the weights that the drivers had, by name, for a column of their own where they are known.
    """
    grid = Table(box=SIMPLE, title=f"learned from {learned.windows} windows", title_justify="left")
    grid.add_column("weight", no_wrap=True)
    for column in ("value", "90 % interval", *(["true"] if true else [])):
        grid.add_column(column, justify="right", no_wrap=True)
    for name, value in learned.weights.items():
        interval = "{:.3g}, {:.3g}".format(*learned.interval(name)) if name in learned.learned else "given"
        grid.add_row(name, f"{value:.4g}", interval, *([f"{true[name]:g}" if name in true else ""] if true else []))
    grid.add_row("temperature", f"{learned.temperature:.3g}", "")
    return grid


def recovery_table(rows: pd.DataFrame) -> Table:
    """Learned over true weights, and what they are worth on held-out demonstrations; brackets: not identifiable."""
    weights = list(dict.fromkeys(rows["weight"]))
    grid = Table(
        title="learned / true weights, (not identifiable)", box=SIMPLE, title_justify="left", title_style="bold"
    )
    grid.add_column("driver", no_wrap=True)
    names = [name.replace("_", " ") for name in weights]
    for column in ("demos", *names, "temperature", "log p", "of the true", "regret"):
        grid.add_column(column, justify="right")
    for (driver, number), some in rows.groupby(["driver", "demonstrations"], sort=False):
        first = some.iloc[0]
        cells = []
        for name in weights:
            row = some[some["weight"] == name].iloc[0]
            ratio = f"{row['learned'] / row['true']:.3g}"
            cells.append(ratio if row["identifiable"] else f"({ratio})")
        worth = [f"{first['log_likelihood']:.2f}", f"{first['log_likelihood_true']:.2f}", f"{first['regret']:.2%}"]
        grid.add_row(str(driver), str(number), *cells, f"{first['temperature']:.2e}", *worth)
    return grid


def evaluation_table(evaluation: Mapping[str, Any]) -> Table:
    """Errors of prediction by horizon."""
    title = f"{evaluation['windows']} stretches of road of {evaluation['tracks']} drivers"
    grid = Table(title=title, box=SIMPLE, title_justify="left", title_style="bold")
    grid.add_column("predicted by", no_wrap=True)
    for column in (*(f"{kind} {horizon} s" for kind in ("FDE", "miss") for horizon in HORIZONS), "log p"):
        grid.add_column(column, justify="right", no_wrap=True)
    for name, (label, *_) in PREDICTORS.items():
        row, horizons = evaluation[name], [str(horizon) for horizon in HORIZONS]
        distances = [f"{row['fde'][horizon]:.2f}" if horizon in row["fde"] else "" for horizon in horizons]
        misses = [f"{row['miss'][horizon]:.0%}" if horizon in row["miss"] else "" for horizon in horizons]
        grid.add_row(label, *distances, *misses, f"{row['log_likelihood']:.2f}")
    return grid


def situations_table(evaluation: Mapping[str, Any]) -> Table:
    """Errors of prediction by what drivers were doing."""
    grid = Table(title="mean error after 3 s, m", box=SIMPLE, title_justify="left", title_style="bold")
    grid.add_column("what drivers did", no_wrap=True)
    for column in ("windows", *(label for label, *_ in PREDICTORS.values())):
        grid.add_column(column, justify="right", no_wrap=True)
    for situation, row in evaluation["situations"].items():
        grid.add_row(situation, str(row["windows"]), *(f"{row[name]:.2f}" for name in PREDICTORS))
    return grid


def load_evaluation(path: Path) -> dict[str, Any]:
    """Read what ``ms-highway irl evaluate --json`` prints.

    Raises:
        ValueError: if there is no such file, or it is no evaluation, naming what it lacks.
    """
    try:
        evaluation = read_json(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as an evaluation: {error}") from error
    remedy = "write it anew with `ms-highway irl evaluate --json`"
    if not isinstance(evaluation, dict):
        raise ValueError(f"{path} is no evaluation; {remedy}")
    missing = [name for name in ("windows", "tracks", "situations", *PREDICTORS) if name not in evaluation]
    for name in PREDICTORS:
        row = evaluation.get(name)
        for kind in ("fde", "miss"):
            values = row.get(kind) if isinstance(row, dict) else None
            usable = isinstance(values, dict) and all(
                horizon.isdecimal() and isinstance(value, (int, float)) for horizon, value in values.items()
            )
            if not usable and name not in missing:
                missing.append(f"{name}.{kind}")
        likely = row.get("log_likelihood") if isinstance(row, dict) else None
        if not isinstance(likely, (int, float)) and name not in missing:
            missing.append(f"{name}.log_likelihood")
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}, or they are no numbers; {remedy}")
    return evaluation


def _ramp(number: int) -> list[str]:
    """So many colours, from few demonstrations to many."""
    places = np.linspace(0, len(NUMBERS) - 1, number) if number > 1 else np.array([len(NUMBERS) - 1.0])
    channels = np.array([[int(color[at : at + 2], 16) for at in (1, 3, 5)] for color in NUMBERS])
    mixed = np.stack([np.interp(places, np.arange(len(NUMBERS)), channel) for channel in channels.T], axis=-1)
    return ["#{:02x}{:02x}{:02x}".format(*color.round().astype(int)) for color in mixed]


def _plain_ticks(axes: Axes) -> None:
    """Ticks at 1, 2 and 5 times powers of ten, at powers only where those are many; written as plain numbers."""
    low, high = axes.get_ylim()
    ticks = TICKS[np.searchsorted(TICKS, low) : np.searchsorted(TICKS, high, "right")]
    axes.set_yticks(ticks if len(ticks) < 10 else ticks[np.isclose(np.log10(ticks) % 1, 0)])
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
