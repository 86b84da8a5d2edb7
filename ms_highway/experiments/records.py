"""Records of steps: their columns, and what is picked out of them."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pandas as pd

from ms_highway.planning.human_models import known_models

__all__ = [
    "CARS",
    "CROWD_COLUMNS",
    "KEYS",
    "MEASURED",
    "STATE",
    "check_columns",
    "columns",
    "common_seeds",
    "gain_column",
    "models_of",
    "one_episode",
    "share_column",
    "state_columns",
    "switches",
    "whole_steps",
]

KEYS = ["scenario", "controller", "seed"]
"""Columns that say which episode a step is of."""

MEASURED = ("planning_seconds", "decision_seconds", "compile_seconds")
"""Columns of times as they were measured, which a simulation does not have."""

COUNTED = "counted_seconds"
CROWD_COLUMNS = ("humans_turn", "humans_tom", "success")
"""Columns of records with several humans: how many of them were predicted by the dearer models, and success so far."""

CARS, STATE = ("robot", "human"), ("x", "y", "heading", "speed")
NEVER_EMPTY = [*KEYS, "step", "model", "status", "reward", "collision", *MEASURED[:2]]
NUMBERS = ("seed", "step", "reward", COUNTED, *MEASURED[:2])


def columns(rungs: Iterable[str] = (), crowd: bool = False) -> list[str]:
    """Return the columns of a record of steps.

    ``counted_seconds`` is T(M), what decisions count for the step's plan; a gain, of which every known human model and
    every rung has one, is empty where none was estimated; states are in SI units after the step, with several humans
    that of the first.

    Args:
        rungs: names of the models on ladders, which may have efforts.
        crowd: whether there are several humans; ``model`` is then the dearest one in use, `CROWD_COLUMNS` are added.
    """
    planning, decision, compiling = MEASURED
    gains = [gain_column(name) for name in known_models(rungs)]
    states = [name for car in CARS for name in state_columns(car)]
    steps = ["step", "model", "reward", "collision", planning, COUNTED, decision, compiling, "status"]
    return [*KEYS, *steps, *gains, *states, *(CROWD_COLUMNS if crowd else ())]


def gain_column(model: str) -> str:
    """Return the column of the estimated gain of switching to a model."""
    return f"gain_{model}"


def state_columns(car: str) -> list[str]:
    """Return the columns of the state of a car, ``robot`` or ``human``, in the order of `STATE`."""
    return [f"{car}_{name}" for name in STATE]


def share_column(model: str) -> str:
    """Return the column of the share of steps that were planned with a model, in tables that summarise records."""
    return f"share_{model}"


def models_of(table: pd.DataFrame, column: Callable[[str], str]) -> list[str]:
    """Return the known models that have such a column, `gain_column` or `share_column`, in a table, cheapest first."""
    names = {str(name).removeprefix(column("")) for name in table if str(name).startswith(column(""))}
    return [name for name in known_models(names) if name in names]


def check_columns(records: pd.DataFrame) -> None:
    """Check that records have the columns that results are made from, and numbers where numbers belong.

    Raises:
        ValueError: naming the columns that are missing, or one that has texts.
    """
    absent = sorted({*NEVER_EMPTY, COUNTED} - set(records))
    if absent:
        raise ValueError(f"has no column {', '.join(absent)}")
    gains = [name for name in records if name.startswith(gain_column(""))]
    for name in (*NUMBERS, *gains):
        if len(records) and not pd.api.types.is_numeric_dtype(records[name]):
            raise ValueError(f"has texts where numbers belong, in column {name}")


def whole_steps(records: pd.DataFrame) -> pd.Series:
    """Return the number of steps without empty cells that every episode has, by `KEYS`."""
    return records.dropna(subset=NEVER_EMPTY).groupby(KEYS).size()


def one_episode(records: pd.DataFrame, scenario: str, controller: str, seed: int) -> pd.DataFrame:
    """Return the records of one episode, in the order of its steps.

    Raises:
        ValueError: if there are none.
    """
    chosen = (records["scenario"] == scenario) & (records["controller"] == controller) & (records["seed"] == seed)
    if not chosen.any():
        raise ValueError(f"there is no episode of {controller!r} in {scenario!r} with seed {seed} in these records")
    return records[chosen].sort_values("step")


def common_seeds(records: pd.DataFrame, scenario: str, controllers: Sequence[str]) -> list[int]:
    """Return the seeds of the episodes that all of these controllers, one at least, have driven, ascending."""
    rows = records[records["scenario"] == scenario]
    driven = (set(rows.loc[rows["controller"] == name, "seed"].tolist()) for name in controllers)
    return sorted(set.intersection(*driven))


def switches(episode: pd.DataFrame) -> list[int]:
    """Return the first step of an episode, and those that were planned with another model than the step before."""
    models = episode["model"].to_numpy()
    return [0, *(np.flatnonzero(models[1:] != models[:-1]) + 1).tolist()]
