"""Tabulate learned rewards and evaluations."""

from collections.abc import Mapping

import numpy as np
from rich.table import Table

from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.evaluation import LEVELS, Evaluation
from ms_highway.irl.moments import HORIZONS
from ms_highway.irl.predictors import PREDICTORS
from ms_highway.visualization.tables import grid

MEASURES = {
    "fde": ("FDE", "{:.2f}"),
    "rmse": ("RMSE", "{:.2f}"),
    "miss": ("miss", "{:.0%}"),
    "log_p": ("log p", "{:.2f}"),
    **{f"inside {level}": (f"in {level} %", "{:.1%}") for level in LEVELS},
}


def learned_tables(learned: LearnedReward, true: Mapping[str, float] | None = None) -> list[Table]:
    """Tabulate a learned reward, and what was learned of drivers, if anything; 90 % intervals.

    The last columns are mean sums of the features over a window: the drivers', and those expected under the reward.

    Args:
        learned: the reward.
        true: the drivers' weights by name, for a further column, if they are known.
    """
    rows = []
    for name in (*learned.weights, "temperature", *(["tails"] if learned.tails else [])):
        value, ends = learned.weights.get(name) or getattr(learned, name), "given" if name in learned.weights else ""
        if name in learned.learned:
            ends = "{:.3g}, {:.3g}".format(*learned.interval(name))
        row = {"weight": name, "value": f"{value:.4g}", "90 % interval": ends}
        if true is not None:
            row["true"] = f"{true[name]:g}" if name in true else ""
        for side, heading in (("human", "feature of drivers"), ("model", "feature expected")):
            counts = learned.feature_counts[side]
            row[heading] = f"{counts[name]:.3g}" if name in counts else ""
        rows.append(row)
    found = [grid(f"learned from {learned.windows} windows", rows)]
    return [*found, _drivers_table(learned.drivers)] if learned.drivers else found


def _drivers_table(drivers: LearnedDrivers) -> Table:
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
        text = "{:.3g}, {:.3g}".format(*ends) if np.isfinite(ends[0]) else "given"
        rows.append({"weight or trait": name, "value": f"{value:.3g}", "90 % interval": text})
    return grid("learned seconds ahead; factors while changing lanes", rows)


def evaluation_tables(evaluation: Evaluation) -> list[Table]:
    """Tabulate an evaluation: all measures by horizon, mean errors and log densities by driving regime, and windows."""
    rows = [
        {"predicted by": label, "after": f"{horizon} s"}
        | {heading: form.format(row[kind][horizon]) for kind, (heading, form) in MEASURES.items()}
        for horizon in map(str, HORIZONS)
        for name, label in PREDICTORS.items()
        if horizon in (row := evaluation.predictors[name])["fde"]
    ]
    title = f"{evaluation.windows} predictions of {evaluation.tracks} drivers, others {evaluation.others}"
    tables = [grid(title, rows)]
    for kind, label in (("distance", "mean error, m"), ("log_p", "mean log density")):
        for horizon in ("3", "5"):
            rows = []
            for regime, row in evaluation.situations[kind].items():
                values = {label: row[name].get(horizon) for name, label in PREDICTORS.items()}
                texts = {label: "" if value is None else f"{value:.2f}" for label, value in values.items()}
                rows.append({"what drivers did": regime, "predictions": f"{row['windows'][horizon]:.0f}", **texts})
            tables += [grid(f"{label}, after {horizon} s", rows)] if rows else []
    likely = evaluation.likelihood
    names = {"model": "learned reward", "constant_velocity": PREDICTORS["constant_velocity"]}
    rows = [{"predicted by": label, "log p per window": f"{likely[name]:.2f}"} for name, label in names.items()]
    return [*tables, grid(f"controls of {likely['windows']:g} windows", rows)]
