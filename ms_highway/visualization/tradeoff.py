"""Draw reward against computation."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ms_highway.envs.registry import controller_settings, fixed_order_types, priced_types
from ms_highway.game.scenario import title
from ms_highway.visualization.style import choosing_shades, color_of, styled

SCHEDULE_COLOR, RANDOM_COLOR, FRONTIER_COLOR = "#8a93a5", "#2e8b57", "#c2185b"
LABEL = np.array([0.08, 0.05])  # width and height of a label, as shares of the axes
COUNTED = "planning per step, counted at T(M) [ms]"


@styled
def curve(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward against computation of every controller; whiskers are the 90 % intervals, but not for schedules.

    On the left, planning is counted at the seconds T(M) that decisions count. On the right are planning and deciding as
    measured on this machine, if they were. A line per kind joins controllers that choose online, in the order of
    lambda. The dashed line is the highest reward of schedules, periods and fixed models with at most this computation.
    Crosses are random controllers.
    """
    rows = summaries.query("scenario == @scenario")
    measures = {"counted_ms": COUNTED}
    if {"planning_ms", "decision_ms"} <= set(rows):
        rows = rows.assign(measured_ms=rows["planning_ms"] + rows["decision_ms"])
        measures["measured_ms"] = "planning + deciding per step, measured [ms]"
    figure = Figure(figsize=(4 + 3 * len(measures), 4.4))
    panels = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
    for axes, (measure, label) in zip(panels, measures.items(), strict=True):
        orders = rows[rows["kind"].isin(fixed_order_types())].sort_values(measure)
        if (orders["kind"] != "fixed").any():
            best = {"linestyle": "--", "drawstyle": "steps-post", "label": "best fixed schedules"}
            axes.plot(orders[measure], orders["reward"], ".", color=SCHEDULE_COLOR, markersize=5)
            axes.plot(orders[measure], orders["reward"].cummax(), color=SCHEDULE_COLOR, **best)
        _draw(axes, rows, measure)
        axes.set_xlabel(label)
    panels[0].set_ylabel("reward per step")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.suptitle(f"{title(scenario)}: reward against computation, {episode_count(rows)}")
    return figure


@styled
def frontier(behind: pd.DataFrame, scenario: str, starts: int) -> Figure:
    """Draw reward against counted computation: the orders of models that a search found, and controllers.

    The line joins, over the prices that were searched, the means of the best orders of each start. Dots are orders that
    are the same for all starts.

    Args:
        behind: rows of `ms_highway.experiments.frontier.regrets`, with columns ``scenario`` and ``price``.
        scenario: its name.
        starts: number of starts.
    """
    rows = behind.query("scenario == @scenario")
    rows = rows.assign(counted_ms=1e3 * rows["counted_seconds"])
    found = rows.query("kind == 'search'").sort_values("counted_ms", ascending=False)
    others = rows.query("kind != 'search'").drop_duplicates("controller")
    orders = others[others["kind"].isin(fixed_order_types()) & (others["kind"] != "fixed")]
    figure = Figure(figsize=(7, 4.4))
    axes, label = figure.subplots(), "best order of each start"
    axes.plot(orders["counted_ms"], orders["reward"], ".", color=SCHEDULE_COLOR, label="orders for all starts")
    axes.plot(found["counted_ms"], found["reward"], "D-", color=FRONTIER_COLOR, label=label)
    prices = [controller_settings(name).price for name in others["controller"]]
    _draw(axes, others.assign(price=prices), "counted_ms")
    axes.set(xlabel=COUNTED, ylabel="reward per step")
    figure.suptitle(f"{title(scenario)}: the best orders of models, {starts} starts")
    searched = ", ".join(f"{price:g}" for price in found["price"])
    axes.set_title(f"diamonds, from the right: a second of planning costs {searched}", fontsize="small")
    figure.legend(loc="outside lower center", ncols=3)
    return figure


def _draw(axes: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Draw the reward of online controllers, random ones and fixed models over a measure of computation."""
    own_kinds = ["fixed", "random", *priced_types()]
    shown = rows[rows["kind"].isin(own_kinds)].sort_values("price", kind="stable")
    names = shown["controller"].str.replace(r"^(\w+):[^:]*", r"\1", regex=True)  # with the file of values, if any
    for name, own in shown.groupby(names, sort=False):
        kind = own["kind"].iloc[0]
        if kind == "fixed":
            form, color, label = "s", color_of(str(name)), name
        elif kind == "random":
            form, color, label = "x", RANDOM_COLOR, kind
        else:
            form, color, label = "o-", choosing_shades(kind)[-1], f"{name}, by lambda"
        reward, errors = own["reward"], whiskers(own)
        axes.errorbar(own[measure], reward, errors, fmt=form, color=color, label=label, capsize=3, linewidth=1.2)
    axes.margins(0.1)  # so that labels of points at the edges are inside
    axes.set_xlim(left=0)
    axes.grid()
    axes.autoscale_view()
    labelled: list[np.ndarray] = []
    for price, *place in shown.dropna(subset="price")[["price", measure, "reward"]].to_numpy(float):
        spot = axes.transAxes.inverted().transform(axes.transData.transform(place))  # as shares of the axes
        if all((np.abs(spot - other) > LABEL).any() for other in labelled):  # else labels would cover each other
            labelled.append(spot)
            axes.annotate(f"{price:.3g}", place, xytext=(5, -11), textcoords="offset points", fontsize="x-small")


def episode_count(rows: pd.DataFrame) -> str:
    """Return the number of episodes of each row of a summary, as text for titles."""
    least, most = rows["episodes"].min(), rows["episodes"].max()
    return f"{most if least == most else f'{least} to {most}'} episodes per controller"


def whiskers(rows: pd.DataFrame) -> list[list[float]]:
    """Return how far the intervals in a summary reach below and above the rewards; 0 without an interval."""
    reward = rows["reward"]
    return [(rows.get(end, reward) - reward).abs().fillna(0).to_list() for end in ("reward_low", "reward_high")]
