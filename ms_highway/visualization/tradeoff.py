"""Draw reward against computation: of a comparison, and of a frontier."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from ms_highway.envs.registry import (
    controller_settings,
    fixed_order_types,
    priced_types,
)
from ms_highway.game.scenario import title
from ms_highway.visualization.style import Look, legend, looks, short, styled


@dataclass(frozen=True)
class TradeoffStyle:
    """Set colours and labels of rewards against computation."""

    schedule_color: str = "#8a93a5"
    """Colour of orders of models that are the same for all starts."""
    frontier_color: str = "#c2185b"
    """Colour of the best orders of each start."""
    counted: str = "planning per step, counted at T(M) [ms]"
    """Label of counted computation."""
    label_width: float = 0.08
    """Width of the label of a point, as a share of the axes."""
    label_height: float = 0.05
    """Height of the label of a point, as a share of the axes."""


STYLE = TradeoffStyle()


@styled
def curve(summaries: pd.DataFrame, scenario: str) -> Figure:
    """Draw reward against computation of every controller.

    Whiskers are the 90 % intervals, but not for schedules. On the left, planning is
    counted at the seconds T(M) that decisions count. On the right are planning and
    deciding as measured on this machine, if they were. A line per kind joins
    controllers that choose online, in the order of lambda. The dashed line is the
    highest reward of schedules and fixed models with at most this computation. Crosses
    are random controllers.
    """
    rows = summaries.query("scenario == @scenario")
    measures = {"counted_ms": STYLE.counted}
    if {"planning_ms", "decision_ms"} <= set(rows):
        rows = rows.assign(measured_ms=rows["planning_ms"] + rows["decision_ms"])
        measures["measured_ms"] = "planning + deciding per step, measured [ms]"
    figure = Figure(figsize=(4 + 3 * len(measures), 4.4))
    panels = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
    for axes, (measure, label) in zip(panels, measures.items(), strict=True):
        orders = rows[rows["kind"].isin(fixed_order_types())].sort_values(measure)
        if (orders["kind"] != "fixed").any():
            _draw_best_orders(axes, orders, measure)
        _draw_controllers(axes, rows, measure)
        axes.set_xlabel(label)
    panels[0].set_ylabel("reward per step")
    legend(figure, *panels[0].get_legend_handles_labels())
    figure.suptitle(
        f"{title(scenario)}: reward against computation, {episode_count(rows)}"
    )
    return figure


def _draw_best_orders(axes: Axes, orders: pd.DataFrame, measure: str) -> None:
    """Draw orders of models, and their highest reward with at most a computation.

    Args:
        axes: where they are drawn.
        orders: rows of a summary, in the order of the measure.
        measure: column of the computation.
    """
    computation = orders[measure]
    reward = orders["reward"]
    color = STYLE.schedule_color
    axes.plot(computation, reward, ".", color=color, markersize=5)
    axes.plot(
        computation,
        reward.cummax(),
        color=color,
        linestyle="--",
        drawstyle="steps-post",
        label="best fixed schedules",
    )


@styled
def frontier(behind: pd.DataFrame, scenario: str, starts: int) -> Figure:
    """Draw reward against counted computation of the best orders and of controllers.

    The line joins, over the prices that were searched, the means of the best orders of
    each start. Dots are orders that are the same for all starts.

    Args:
        behind: rows of `ms_highway.experiments.frontier.regrets`, with columns
            ``scenario`` and ``price``.
        scenario: its name.
        starts: number of starts.
    """
    rows = behind.query("scenario == @scenario")
    rows = rows.assign(counted_ms=1e3 * rows["counted_seconds"])
    best = rows.query("kind == 'search'").sort_values("counted_ms", ascending=False)
    others = rows.query("kind != 'search'").drop_duplicates("controller")
    is_order = others["kind"].isin(fixed_order_types()) & (others["kind"] != "fixed")
    orders = others[is_order]

    figure = Figure(figsize=(7, 4.4))
    axes = figure.subplots()
    axes.plot(
        orders["counted_ms"],
        orders["reward"],
        ".",
        color=STYLE.schedule_color,
        label="orders for all starts",
    )
    axes.plot(
        best["counted_ms"],
        best["reward"],
        "D-",
        color=STYLE.frontier_color,
        label="best order of each start",
    )
    prices = [controller_settings(name).price for name in others["controller"]]
    _draw_controllers(axes, others.assign(price=prices), "counted_ms")
    axes.set(xlabel=STYLE.counted, ylabel="reward per step")
    figure.suptitle(f"{title(scenario)}: the best orders of models, {starts} starts")
    searched = ", ".join(f"{price:g}" for price in best["price"])
    axes.set_title(
        f"diamonds, from the right: a second of planning costs {searched}",
        fontsize="small",
    )
    legend(figure, *axes.get_legend_handles_labels())
    return figure


def _draw_controllers(axes: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Draw the reward of all controllers but fixed orders over a computation.

    Controllers that differ only in lambda are joined by a line, and random ones have
    one label.
    """
    is_order = rows["kind"].isin([*fixed_order_types(), "search"])
    shown = rows[~is_order | (rows["kind"] == "fixed")]
    look = looks(rows["controller"])

    # Controllers of one series: the kind, with the file, if any, but without lambda.
    names = shown["controller"]
    without_lambda = names.str.replace(r"^(\w+):[^:+]*", r"\1", regex=True)
    series = names.mask(shown["kind"].isin(priced_types()), without_lambda)
    series = series.mask(shown["kind"] == "random", "random")
    for name, own in shown.assign(series=series).groupby("series", sort=False):
        _draw_series(axes, str(name), own, measure, look)

    # Labels of points at the edges are inside.
    axes.margins(0.1)
    axes.set_xlim(left=0)
    axes.grid()
    axes.autoscale_view()
    _label_prices(axes, shown, measure)


def _draw_series(
    axes: Axes,
    name: str,
    own: pd.DataFrame,
    measure: str,
    look: Mapping[str, Look],
) -> None:
    """Draw the controllers of a series, which have one label.

    Args:
        axes: where they are drawn.
        name: of the series.
        own: rows of its controllers.
        measure: column of the computation.
        look: how all controllers look.
    """
    first = look[own["controller"].iloc[0]]
    kind = own["kind"].iloc[0]
    form: dict = {"marker": first.marker, "linestyle": "none", "label": first.label}
    if kind in priced_types():
        own = own.sort_values("price", kind="stable")
        form |= {"linestyle": first.line, "label": f"{short(name)}, by lambda"}
    elif kind == "random":
        form |= {"marker": "x", "label": kind}
    elif kind == "fixed":
        # Large and behind, so that it is seen around others in the same place.
        form |= {"markersize": 9, "zorder": 1.9}
    axes.errorbar(
        own[measure],
        own["reward"],
        whiskers(own),
        color=first.color,
        capsize=3,
        linewidth=1.2,
        **form,
    )


def _label_prices(axes: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Label points by lambda, unless a label would cover another one."""
    # Over whiskers and markers.
    halo = [withStroke(linewidth=2, foreground="white")]
    size = np.array([STYLE.label_width, STYLE.label_height])
    labelled: list[np.ndarray] = []
    priced = rows.dropna(subset="price")
    for price, *place in priced[["price", measure, "reward"]].to_numpy(float):
        pixels = axes.transData.transform(place)
        share_of_axes = axes.transAxes.inverted().transform(pixels)
        apart = [(np.abs(share_of_axes - other) > size).any() for other in labelled]
        if not all(apart):
            continue
        labelled.append(share_of_axes)
        axes.annotate(
            f"{price:.3g}",
            tuple(place),
            path_effects=halo,
            xytext=(5, -11),
            textcoords="offset points",
            fontsize="x-small",
        )


def episode_count(rows: pd.DataFrame) -> str:
    """Return the number of episodes of each row of a summary, as text for titles."""
    least = rows["episodes"].min()
    most = rows["episodes"].max()
    count = f"{most}" if least == most else f"{least} to {most}"
    return f"{count} episodes per controller"


def whiskers(rows: pd.DataFrame) -> list[list[float]]:
    """Return how far the intervals in a summary reach below and above the rewards.

    They are 0 without an interval.
    """
    reward = rows["reward"]
    reaches = []
    for end in ("reward_low", "reward_high"):
        reach = (rows.get(end, reward) - reward).abs()
        reaches.append(reach.fillna(0).to_list())
    return reaches
