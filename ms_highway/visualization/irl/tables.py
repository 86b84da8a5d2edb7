"""Tabulate learned rewards and evaluations."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.evaluation import LEVELS, Evaluation
from ms_highway.irl.moments import HORIZONS
from ms_highway.irl.predictors import PREDICTORS

MEASURES = {
    "fde": ("FDE", "{:.2f}"),
    "rmse": ("RMSE", "{:.2f}"),
    "miss": ("miss", "{:.0%}"),
    "log_p": ("log p", "{:.2f}"),
    **{f"inside {level}": (f"in {level} %", "{:.1%}") for level in LEVELS},
}


def learned_tables(learned: LearnedReward, true: Mapping[str, float] | None = None) -> list[Table]:
    """Tabulate a learned reward, with the 90 % intervals of its weights, and what was learned of drivers, if anything.

    Args:
        learned: the reward.
        true: the drivers' weights by name, for a further column, if they are known.
    """
    rows = [
        [name, f"{value:.4g}", "{:.3g}, {:.3g}".format(*learned.interval(name)) if name in learned.learned else "given"]
        for name, value in learned.weights.items()
    ]
    rows += [[name, f"{value:.3g}", ""] for name in ("temperature", "tails") if (value := getattr(learned, name))]
    if true is not None:
        rows = [[*row, f"{true[row[0]]:g}" if row[0] in true else ""] for row in rows]
    columns = ["weight", "value", "90 % interval", *([] if true is None else ["true"])]
    found = [_grid(f"learned from {learned.windows} windows", columns, rows)]
    return [*found, _drivers(learned.drivers)] if learned.drivers else found


def _drivers(drivers: LearnedDrivers) -> Table:
    """Tabulate what was learned seconds ahead, with 90 % intervals by driver where they were computed."""
    prior = drivers.prior
    numbers = {
        **drivers.weights,
        "typical headway": prior.median[1],
        **dict(zip(("desired speeds", "headways", "patiences"), prior.deviations, strict=True)),
        "noise": prior.noise,
        **{f"{name} while changing lanes": value for name, value in drivers.changing.items()},
    }
    rows = []
    for name, value in numbers.items():
        ends = value * np.exp(1.645 * drivers.deviations.get(name, np.nan) * np.array([-1, 1]))
        rows.append([name, f"{value:.3g}", "{:.3g}, {:.3g}".format(*ends) if np.isfinite(ends[0]) else "given"])
    columns = ["weight or trait", "value", "90 % interval"]
    return _grid("learned seconds ahead; factors while changing lanes", columns, rows)


def evaluation_tables(evaluation: Evaluation) -> list[Table]:
    """Tabulate an evaluation: all measures by horizon, mean errors and log densities by driving regime, and windows."""
    rows = [
        [label, f"{horizon} s", *(form.format(row[kind][horizon]) for kind, (_, form) in MEASURES.items())]
        for horizon in map(str, HORIZONS)
        for name, label in PREDICTORS.items()
        if horizon in (row := evaluation.predictors[name])["fde"]
    ]
    title = f"{evaluation.windows} predictions of {evaluation.tracks} drivers, others {evaluation.others}"
    tables = [
        _grid(title, ["predicted by", "after", *(label for label, _ in MEASURES.values())], rows, len(PREDICTORS))
    ]
    columns = ["what drivers did", "predictions", *PREDICTORS.values()]
    for kind, label in (("distance", "mean error, m"), ("log_p", "mean log density")):
        for horizon in ("3", "5"):
            rows = []
            for regime, row in evaluation.situations[kind].items():
                cells = [row[name].get(horizon) for name in PREDICTORS]
                texts = ("" if value is None else f"{value:.2f}" for value in cells)
                rows.append([regime, f"{row['windows'][horizon]:.0f}", *texts])
            tables.append(_grid(f"{label}, after {horizon} s", columns, rows))
    likely = evaluation.likelihood
    names = {"model": "learned reward", "constant_velocity": PREDICTORS["constant_velocity"]}
    rows = [[label, f"{likely[name]:.2f}"] for name, label in names.items()]
    return [*tables, _grid(f"controls of {likely['windows']:g} windows", ["predicted by", "log p per window"], rows)]


def _grid(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], section: int = 0) -> Table:
    """Return a table, with a line after every so many rows."""
    grid = Table(title=title, box=SIMPLE, title_justify="left", title_style="bold")
    for place, column in enumerate(columns):
        grid.add_column(column, justify="right" if place else "left", no_wrap=not place or " " not in column)
    for number, row in enumerate(rows, 1):
        grid.add_row(*row, end_section=bool(section) and number % section == 0)
    return grid
