"""Tabulate learned rewards, recovered weights and evaluations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from rich.box import SIMPLE
from rich.table import Table

from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.errors import HORIZONS, LEVELS
from ms_highway.irl.predictors import PREDICTORS

__all__ = ["drivers_table", "evaluation_tables", "learned_table", "recovery_table"]


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
    if learned.tails is not None:
        grid.add_row("tails", f"{learned.tails:.3g}", "")
    return grid


def drivers_table(drivers: LearnedDrivers) -> Table:
    """Tabulate what was learned of drivers seconds ahead, with 90 % intervals by driver where they were computed."""
    title = "learned seconds ahead; factors while changing lanes"
    grid = _grid(title, ["value", "90 % interval"], "weight or trait")
    prior = drivers.prior
    traits = {
        "typical headway": prior.median[1],
        **dict(zip(("desired speeds", "headways", "patiences"), prior.deviations, strict=True)),
        "noise": prior.noise,
    }
    changing = {f"{name} while changing lanes": value for name, value in drivers.changing.items()}
    for name, value in {**drivers.weights, **traits, **changing}.items():
        spread = drivers.deviations.get(name)
        ends = None if spread is None else value * np.exp([-1.645 * spread, 1.645 * spread])
        grid.add_row(name, f"{value:.3g}", "given" if ends is None else f"{ends[0]:.3g}, {ends[1]:.3g}")
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


def evaluation_tables(evaluation: Mapping[str, Any]) -> tuple[Table, ...]:
    """Tabulate an evaluation: all measures by horizon, situations, and windows."""
    return _measures(evaluation), *_situations(evaluation), _windows(evaluation)


MEASURES = {
    "fde": ("FDE", "{:.2f}"),
    "rmse": ("RMSE", "{:.2f}"),
    "miss": ("miss", "{:.0%}"),
    "log_p": ("log p", "{:.2f}"),
}
MEASURES |= {f"inside {level}": (f"in {level} %", "{:.1%}") for level in LEVELS}


def _measures(evaluation: Mapping[str, Any]) -> Table:
    number, tracks, others = (evaluation[part] for part in ("windows", "tracks", "others"))
    grid = _grid(
        f"{number} predictions of {tracks} drivers, others {others}",
        ["after", *(label for label, _ in MEASURES.values())],
    )
    for horizon in map(str, HORIZONS):
        for name, label in PREDICTORS.items():
            row = evaluation["predictors"].get(name, {})
            cells = [form.format(row[kind][horizon]) for kind, (_, form) in MEASURES.items() if horizon in row[kind]]
            if cells:
                grid.add_row(label, f"{horizon} s", *cells)
        grid.add_section()
    return grid


def _situations(evaluation: Mapping[str, Any]) -> list[Table]:
    """Tabulate mean distance and log density after 3 and 5 s, by driving regime."""
    tables = []
    for kind, title in (("distance", "mean error, m"), ("log_p", "mean log density")):
        for horizon in ("3", "5"):
            grid = _grid(f"{title}, after {horizon} s", ["predictions", *PREDICTORS.values()], "what drivers did")
            for situation, row in evaluation["situations"][kind].items():
                cells = [row.get(name, {}).get(horizon) for name in PREDICTORS]
                count = f"{row['windows'][horizon]:.0f}"
                grid.add_row(situation, count, *("" if value is None else f"{value:.2f}" for value in cells))
            tables.append(grid)
    return tables


def _windows(evaluation: Mapping[str, Any]) -> Table:
    likely = evaluation["likelihood"]
    grid = _grid(f"controls of {likely['windows']} windows", ["log p per window"])
    for name in ("model", "constant_velocity"):
        grid.add_row({"model": "learned reward"}.get(name, PREDICTORS[name]), f"{likely[name]:.2f}")
    return grid


def _grid(title: str, columns: Sequence[str], first: str = "predicted by") -> Table:
    grid = Table(title=title, box=SIMPLE, title_justify="left", title_style="bold")
    grid.add_column(first, no_wrap=True)
    for column in columns:
        grid.add_column(column, justify="right", no_wrap=" " not in column)
    return grid
