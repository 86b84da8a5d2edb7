"""Show how much better choices of models could be: what `ms-highway frontier` found."""

from math import log
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from ms_highway.envs.controllers import CHOOSING
from ms_highway.experiments.analysis.regret import REGRETS_FILE
from ms_highway.experiments.directory import ResultsDirectory
from ms_highway.game.scenario import title
from ms_highway.runtime.files import reading
from ms_highway.visualization.colors import choosing_shades, color_of, light_grid
from ms_highway.visualization.section import Section
from ms_highway.visualization.tables import regret_tables

REMEDY = "run the same `ms-highway frontier` again"
TEXTS = ["controller", "kind", "scenario"]
NUMBERS = ["price", "reward", "counted_seconds", "meta_reward", "regret", "regret_low", "regret_high"]
TOLD_KINDS = "learned", "switching", "fixed"
TOLD_PRICE = 1.0  # reward per second: the searched price that is nearest to it is told of


def read_regrets(directory: Path) -> pd.DataFrame:
    """Read the regrets that a search for the best orders wrote to a directory.

    Raises:
        ValueError: if the file cannot be read or lacks a column.
    """
    path = directory / REGRETS_FILE
    with reading(path, REMEDY, " as regrets"):
        table = pd.read_csv(path, dtype=dict.fromkeys(TEXTS, str) | dict.fromkeys(NUMBERS, float))
        if lacking := [name for name in TEXTS + NUMBERS if name not in table]:
            raise ValueError(f"it has no column {lacking[0]!r}")
        whole = np.isfinite(table[["price", "reward", "counted_seconds", "meta_reward", "regret"]]).all(axis=None)
        if table.empty or not whole or not (table["price"] > 0).all():
            raise ValueError("it has no rows, or prices or regrets that are no numbers")
        if table.duplicated(["scenario", "price", "controller"]).any():
            raise ValueError("it has a controller twice at one price")
    return table


def regrets_section(directory: Path) -> Section:
    """Return the section of a directory of regrets.

    Raises:
        ValueError: as `read_regrets`.
    """
    behind = read_regrets(directory)
    scenarios = list(dict.fromkeys(behind["scenario"]))
    caption = (
        "Regret: how far the reward less price times T(M) stays behind that of the best order of models found for each "
        "start. Of controllers that have a lambda, the best one at each price; whiskers are the 90 % intervals over "
        "starts."
    )
    return Section(
        f"Best orders: {directory}",
        "How much better could the choice of models be?",
        regrets_told(behind),
        [table for scenario in scenarios for table in regret_tables(behind, scenario)],
        {"regrets": (regret_figure(behind), caption)},
        ResultsDirectory(directory).made(),
    )


def regrets_told(behind: pd.DataFrame) -> str:
    """Say how far learned values, Algorithm 1 and fixed models stay behind, at the searched price nearest to 1."""
    price = min(set(behind["price"]), key=lambda price: abs(log(price / TOLD_PRICE)))
    parts = []
    for scenario, rows in behind[behind["price"] == price].groupby("scenario", sort=False):
        own = rows.set_index("controller")
        least = [own.loc[own["kind"] == kind, "regret"].idxmin() for kind in TOLD_KINDS if kind in set(own["kind"])]
        regrets = [f"{name} {_with_interval(own.loc[name])}" for name in least]
        parts.append(f"in {title(str(scenario))} {', '.join(regrets)}")
    return (
        f"Behind the best order of models found for each start, where a second of planning costs {price:g}, the least "
        f"regret per step of each kind is {'; '.join(parts)}."
    )


def _with_interval(row: pd.Series) -> str:
    low, high = row["regret_low"], row["regret_high"]
    return f"{row['regret']:.2f}" + (f" ({low:.2f}, {high:.2f})" if np.isfinite(low) else "")


def regret_figure(behind: pd.DataFrame) -> Figure:
    """Draw regret against price, a panel for each scenario."""
    scenarios = list(dict.fromkeys(behind["scenario"]))
    figure = Figure(figsize=(3.4 * len(scenarios) + 0.6, 3.8), layout="constrained")
    panels = figure.subplots(1, len(scenarios), squeeze=False)[0]
    for axes, scenario in zip(panels, scenarios, strict=True):
        own = behind.query("scenario == @scenario")
        lines = [(name, color_of(str(name)), rows) for name, rows in own.query("kind == 'fixed'").groupby("controller")]
        for kind in [kind for kind in CHOOSING if kind in set(own["kind"])]:
            rows = own[own["kind"] == kind]
            least = rows.loc[rows.groupby("price")["regret"].idxmin()]
            lines.append((f"{kind}, best lambda", choosing_shades(kind)[0], least))
        for name, color, rows in lines:
            rows = rows.sort_values("price")
            ends = [(rows[end] - rows["regret"]).abs().fillna(0) for end in ("regret_low", "regret_high")]
            axes.errorbar(rows["price"], rows["regret"], ends, fmt="o-", color=color, label=name, capsize=3)
        axes.set(xscale="log", title=title(scenario), xlabel="price of a second of planning [reward]")
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_ylim(bottom=0)
        light_grid(axes)
    panels[0].set_ylabel("regret per step")
    handles = {
        label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=6, frameon=False)
    return figure
