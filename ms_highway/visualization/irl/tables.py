"""Tabulate learned rewards, recovered weights and evaluations."""

from collections.abc import Mapping
from typing import Any

import pandas as pd
from rich.box import SIMPLE
from rich.table import Table

from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.prediction import HORIZONS
from ms_highway.visualization.irl.prediction import PREDICTORS

__all__ = ["evaluation_table", "learned_table", "recovery_table", "regimes_table"]


def learned_table(learned: LearnedReward, true: Mapping[str, float] | None = None) -> Table:
    """Tabulate a learned reward, with the 90 % intervals of its weights.

    Args:
        learned: the reward.
        true: the drivers' weights by name, for a further column, if they are known.
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
    """Tabulate learned over true weights, likelihood and regret on held-out demonstrations; (not identifiable)."""
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
    """Tabulate errors of prediction by horizon."""
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


def regimes_table(evaluation: Mapping[str, Any]) -> Table:
    """Tabulate errors of prediction by driving regime."""
    grid = Table(title="mean error after 3 s, m", box=SIMPLE, title_justify="left", title_style="bold")
    grid.add_column("what drivers did", no_wrap=True)
    for column in ("windows", *(label for label, *_ in PREDICTORS.values())):
        grid.add_column(column, justify="right", no_wrap=True)
    for situation, row in evaluation["situations"].items():
        grid.add_row(situation, str(row["windows"]), *(f"{row[name]:.2f}" for name in PREDICTORS))
    return grid
