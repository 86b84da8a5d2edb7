"""The figure of reward against computation."""

from collections.abc import Iterable

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from ms_highway.experiments.analysis.tradeoff import best_schedules, choosing, reference
from ms_highway.game.scenario import title
from ms_highway.visualization.colors import choosing_shades, color_of
from ms_highway.visualization.comparison import episode_count

__all__ = ["curve"]

SCHEDULE_COLOR, RANDOM_COLOR = "#8a93a5", "#2e8b57"
LABEL = 0.08, 0.05  # width and height of a label, as shares of the axes


def curve(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward against computation of every controller; whiskers are the 90 % intervals, left out of schedules.

    On the left, planning is counted at the seconds T(M) that decisions count; on the right, where they were measured,
    planning and deciding are as on this machine. Controllers that choose online are joined in the order of lambda, a
    line per kind; the dashed line joins `best_schedules`; crosses are random controllers.
    """
    rows = summaries[summaries["scenario"] == scenario]
    measured = {"planning_ms", "decision_ms"} <= set(rows)
    figure = Figure(figsize=(10 if measured else 7, 4.4), layout="constrained")
    left, *right = figure.subplots(1, 2 if measured else 1, sharey=True, squeeze=False)[0]
    _draw(left, rows, best_schedules(rows, scenario), "counted_ms")
    left.set(xlabel="planning per step, counted at T(M) [ms]", ylabel="reward per step")
    for axes in right:
        rows = rows.assign(measured_ms=rows["planning_ms"] + rows["decision_ms"])
        _draw(axes, rows, best_schedules(rows, scenario, "measured_ms"), "measured_ms")
        axes.set(xlabel="planning + deciding per step, measured [ms]")
    _share_axes(left, summaries, scenario)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    figure.suptitle(f"{title(scenario)}: reward against computation, {episode_count(rows)}")
    return figure


def _share_axes(axes: Axes, summaries: pd.DataFrame, scenario: str) -> None:
    """Draw a second scale of computation, in shares of the dearest fixed model's."""
    name = reference(summaries, scenario)
    if name is None:
        return
    rows = summaries[summaries["scenario"] == scenario].set_index("controller")
    whole = rows.loc[name, "counted_ms"]
    top = axes.secondary_xaxis("top", functions=(lambda ms: ms / whole, lambda part: part * whole))
    top.xaxis.set_major_formatter(PercentFormatter(1.0))
    top.set_xlabel(f"share of {name}'s planning")


def _draw(axes: Axes, rows: pd.DataFrame, best: pd.DataFrame, computation: str) -> None:
    """Draw all controllers over one measure of computation."""
    schedules, online = rows[rows["kind"].isin(("schedule", "period"))], choosing(rows)
    if len(schedules):
        axes.plot(schedules[computation], schedules["reward"], ".", color=SCHEDULE_COLOR, markersize=5)
        axes.plot(best[computation], best["reward"], "--", color=SCHEDULE_COLOR, label="best fixed schedules")
    for name, one in online.items():
        _points(axes, one, computation, "o-", choosing_shades(one["kind"].iloc[0])[-1], f"{name}, by lambda")
    chance = rows[rows["kind"] == "random"]
    if len(chance):
        _points(axes, chance, computation, "x", RANDOM_COLOR, "random")
    for price, place in _apart(online.values(), rows, computation):
        axes.annotate(f"{price:.3g}", place, xytext=(5, -11), textcoords="offset points", fontsize="x-small")
    for name, one in rows[rows["kind"] == "fixed"].groupby("controller", sort=False):
        _points(axes, one, computation, "s", color_of(str(name)), str(name))
    axes.set_xlim(left=0)
    axes.grid(color="#eeeeee")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _apart(
    online: Iterable[pd.DataFrame], rows: pd.DataFrame, computation: str
) -> list[tuple[float, tuple[float, float]]]:
    """Those lambdas, with their points, whose labels would not cover each other."""
    width = rows[computation].max()
    height = rows["reward_high"].fillna(rows["reward"]).max() - rows["reward_low"].fillna(rows["reward"]).min()
    chosen: list[tuple[float, tuple[float, float]]] = []
    points = [point for one in online for point in one[["price", computation, "reward"]].to_numpy(float).tolist()]
    for price, x, y in points:
        if all(abs(x - u) > LABEL[0] * width or abs(y - v) > LABEL[1] * height for _, (u, v) in chosen):
            chosen.append((price, (x, y)))
    return chosen


def _points(axes: Axes, rows: pd.DataFrame, computation: str, form: str, color: str, label: str) -> None:
    """Controllers with the intervals of their rewards; a single episode has none."""
    below, above = rows["reward"] - rows["reward_low"], rows["reward_high"] - rows["reward"]
    errors = [below.fillna(0), above.fillna(0)]
    axes.errorbar(
        rows[computation], rows["reward"], errors, fmt=form, color=color, label=label, capsize=3, linewidth=1.2
    )
