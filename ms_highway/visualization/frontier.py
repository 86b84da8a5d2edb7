"""Draw what a search for the best orders of models has found: tables and a figure."""

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.box import SIMPLE
from rich.table import Table

from ms_highway.envs.controllers import CHOOSING, FIXED_ORDERS
from ms_highway.envs.short_names import named_controller
from ms_highway.experiments.analysis.regret import frontier_curve, remarks
from ms_highway.game.scenario import title
from ms_highway.visualization.colors import color_of

__all__ = ["figure", "regret_table", "regret_tables"]

FRONTIER_COLOR, SCHEDULE_COLOR, OTHER_COLOR = "#c2185b", "#8a93a5", "#2e8b57"
PRICED_COLORS = "#1b1f27", "#e07b00", "#6a51a3"  # of the kinds of controllers that have a lambda
MEANS = ["reward", "counted_seconds"]
LABEL = np.array([0.08, 0.05])  # width and height of a label, as shares of the axes
NAME_WIDTH, REMARK_WIDTH = 32, 24  # characters


def regret_tables(behind: pd.DataFrame, scenario: str) -> list[Table]:
    """Return regrets per step in one scenario, a table per price, of the controllers that `remarks` selects.

    Args:
        behind: rows of `ms_highway.experiments.analysis.regret.regrets`, with columns ``scenario`` and ``price``.
        scenario: its name.
    """
    tables = []
    for price, rows in behind.groupby("price", sort=False):
        own = rows[rows["scenario"] == scenario].set_index("controller")
        tables.append(regret_table(own, remarks(rows, scenario, price), scenario, price))
    return tables


def regret_table(behind: pd.DataFrame, said: Mapping[str, str], scenario: str, price: float) -> Table:
    """Return regrets per step at one price in one scenario.

    Args:
        behind: of `ms_highway.experiments.analysis.regret.regrets`.
        said: remarks by controller, in the order of the rows; only these are shown.
        scenario: its name.
        price: at which they are judged.
    """
    grid = Table(title=f"{scenario}, a second of planning costs {price:g}", box=SIMPLE, title_justify="left")
    grid.add_column("controller", overflow="fold", max_width=NAME_WIDTH)
    grid.add_column("", max_width=REMARK_WIDTH)
    for column in ("reward", "counted ms", "meta-reward", "regret", "90 % interval"):
        grid.add_column(column, justify="right", no_wrap=True)
    for name, remark in said.items():
        row = behind.loc[name]
        interval = "" if np.isnan(row["regret_low"]) else f"{row['regret_low']:.3f}, {row['regret_high']:.3f}"
        means = f"{row['reward']:.2f}", f"{1e3 * row['counted_seconds']:.0f}", f"{row['meta_reward']:.3f}"
        grid.add_row(str(name), remark, *means, f"{row['regret']:.3f}", interval)
    return grid


def figure(table: pd.DataFrame, behind: pd.DataFrame, scenario: str, seeds: Sequence[int]) -> Figure:
    """Draw reward against counted computation: what was found, and the controllers that stay behind it.

    The line joins the means of the best orders of each start from price to price; at prices that were not searched it
    is a lower bound all the same. Dots are orders that were tried from every start.

    Args:
        table: of `ms_highway.experiments.frontier.Outcomes`.
        behind: rows of `ms_highway.experiments.analysis.regret.regrets`, with columns ``scenario`` and ``price``.
        scenario: its name.
        seeds: of the starts.
    """
    rows = behind[behind["scenario"] == scenario]
    frame = Figure(figsize=(7, 4.4), layout="constrained")
    axes = frame.subplots()
    shared = pd.DataFrame({name: table[name].unstack("seed")[list(seeds)].dropna().mean(axis=1) for name in MEANS})
    orders = [named_controller(str(name)).type in FIXED_ORDERS for name in shared.index]
    _points(axes, shared[orders], ".", SCHEDULE_COLOR, "other orders")
    _points(axes, frontier_curve(table, seeds), "-", FRONTIER_COLOR, None)
    searched = rows[rows["kind"] == "search"].sort_values("counted_seconds", ascending=False)
    prices = ", ".join(f"{price:g}" for price in searched["price"])
    _points(axes, searched, "D", FRONTIER_COLOR, "best order of each start")
    own = rows.drop_duplicates("controller").set_index("controller")
    priced = own[own["kind"].isin(CHOOSING)].sort_values("counted_seconds")
    for color, (kind, group) in zip(cycle(PRICED_COLORS), priced.groupby("kind", sort=False), strict=False):
        _points(axes, group, "o", color, f"{kind}, by lambda")
    chance = own[own["kind"] == "random"]
    if len(chance):
        _points(axes, chance, "x", OTHER_COLOR, "random")
    for name, row in own[own["kind"] == "fixed"].iterrows():
        _points(axes, row.to_frame().T, "s", color_of(str(name)), str(name))
    axes.set(xlabel="planning per step, counted at T(M) [ms]", ylabel="reward per step", xlim=(0, None))
    _label_lambdas(axes, priced)
    frame.suptitle(f"{title(scenario)}: the best orders of models, {len(seeds)} starts")
    axes.set_title(f"diamonds, from the right: a second of planning costs {prices}", fontsize="small")
    axes.grid(color="#eeeeee")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    frame.legend(loc="outside lower center", ncols=3, frameon=False)
    return frame


def _points(axes: Axes, rows: pd.DataFrame, form: str, color: str, label: str | None) -> None:
    axes.plot(1e3 * rows["counted_seconds"].astype(float), rows["reward"].astype(float), form, color=color, label=label)


def _label_lambdas(axes: Axes, priced: pd.DataFrame) -> None:
    """Label those lambdas whose labels do not cover each other."""
    labelled: list[np.ndarray] = []
    for name, row in priced.iterrows():
        place = 1e3 * row["counted_seconds"], row["reward"]
        spot = axes.transAxes.inverted().transform(axes.transData.transform(place))  # as shares of the axes
        if all((np.abs(spot - other) > LABEL).any() for other in labelled):
            labelled.append(spot)
            text = str(name).partition(":")[2]
            axes.annotate(text, place, xytext=(4, -10), textcoords="offset points", fontsize="x-small")
