"""Define the columns of records of steps, check and select records, and summarise them by episode."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ms_highway.envs import ENVIRONMENTS
from ms_highway.loop.fallback import BRAKING, LATE, PREVIOUS_PLAN, STATUSES, WAY_OUT
from ms_highway.planning.human_models import is_model, known_models, model_names

KEYS = ["scenario", "controller", "seed"]
"""Columns that say which episode a step is of."""

MEASURED = ("planning_seconds", "decision_seconds", "compile_seconds")
"""Columns of times as they were measured, which a simulation does not have."""

CARS, STATE = ("robot", "human"), ("x", "y", "heading", "speed")
NEVER_EMPTY = [*KEYS, "step", "model", "status", "reward", "collision", *MEASURED[:2]]
COUNTED = "counted_seconds"
TEXTS = ("scenario", "controller", "model", "status")
FAILED = STATUSES[PREVIOUS_PLAN], STATUSES[BRAKING]
LARGEST = 1e38  # number, in single precision


def columns(rungs: Iterable[str] = (), above: Iterable[str] | None = None) -> list[str]:
    """Return the columns of a record of steps.

    ``counted_seconds`` is T of the step's plan as decisions count it; a gain, of which every known human model and
    every rung has one, is the highest over all humans, empty where none was estimated; states are in SI units after the
    step, that of the first human. Where there are several humans, ``model`` is the most expensive one in use,
    ``humans_MODEL`` the number of humans that each rung above the first predicts, and ``success`` whether the robot has
    succeeded so far.

    Args:
        rungs: names of the models on ladders, which may have efforts.
        above: of those above the first, where there are several humans; otherwise None.
    """
    planning, decision, compiling = MEASURED
    gains = [gain_column(name) for name in known_models(rungs)]
    states = [name for car in CARS for name in state_columns(car)]
    steps = ["step", "model", "reward", "collision", planning, COUNTED, decision, compiling, "status"]
    several = [] if above is None else [*dict.fromkeys(map(count_column, above)), "success"]
    return [*KEYS, *steps, *gains, *states, *several]


def gain_column(model: str) -> str:
    """Return the column of the estimated gain of switching to a model."""
    return f"gain_{model}"


def state_columns(car: str) -> list[str]:
    """Return the columns of the state of a car, ``robot`` or ``human``, in the order of `STATE`."""
    return [f"{car}_{name}" for name in STATE]


def by_column(gains: Mapping[str, Any], states: Any) -> dict[str, Any]:
    """Return gains by model, and the states [..., cars, 4] of the first cars, by the columns of records."""
    cells = {gain_column(name): gain for name, gain in gains.items()}
    for car, state in zip(CARS, np.moveaxis(states, (-2, -1), (0, 1)), strict=False):
        cells |= dict(zip(state_columns(car), state, strict=True))
    return cells


def share_column(model: str) -> str:
    """Return the column of the share of steps that were planned with a model, in tables that summarise records."""
    return f"share_{model}"


def count_column(model: str) -> str:
    """Return the column of the number of humans that a model predicts, in records and in tables that summarise them."""
    return f"humans_{model}"


def models_of(table: pd.DataFrame, column: Callable[[str], str]) -> list[str]:
    """Return the known models that have such a column, such as `gain_column`, in a table, cheapest first."""
    names = {str(name).removeprefix(column("")) for name in table if str(name).startswith(column(""))}
    return [name for name in known_models(names) if name in names]


def per_episode(steps: pd.DataFrame, models: Iterable[str] = ()) -> pd.DataFrame:
    """Return a row per episode, in the order of the steps.

    Columns: ``scenario``, ``controller`` and ``seed``; ``reward``, ``counted_seconds`` and, where they were measured,
    ``planning_seconds`` and ``decision_seconds`` as means over the steps, empty where a step's is; ``share_MODEL`` of
    the steps; ``collisions``, steps in which the robot collided; ``fallbacks``, steps whose plan failed; ``way_out``
    and, where times were measured, ``late``, shares of the steps driven to keep a way out, and with an old plan because
    the new one was late. Where scenarios have several humans, there are ``success``, 0 or 1, at the end, and the mean
    of ``humans_MODEL``; the share of a model is of the steps in which it is the most expensive one in use.

    Args:
        steps: records; those of an episode follow each other.
        models: whose shares are wanted; by default, all known ones.
    """
    models = list(models) or known_models(steps["model"].unique())
    marks = {share_column(name): steps["model"] == name for name in models}
    marks |= {"collisions": steps["collision"], "fallbacks": steps["status"].isin(FAILED)}
    marks |= {"way_out": steps["status"] == STATUSES[WAY_OUT], "late": steps["status"] == STATUSES[LATE]}
    episodes = steps.assign(**marks).groupby((steps["step"] == 0).cumsum())
    measured = [name for name in MEASURED[:2] if name in steps]
    counts = [count_column(name) for name in models_of(steps, count_column)]
    shares = [*map(share_column, models), *counts, "way_out", *(["late"] if measured else [])]
    means = episodes[["reward", COUNTED, *measured, *shares]]
    table = episodes[KEYS].first().join(means.mean().where(means.count().eq(episodes.size(), axis=0)))
    table = table.join(episodes[["collisions", "fallbacks"]].sum())
    if "success" in steps:
        ended = episodes["success"].last()  # empty where there is one human
        table["success"] = ended if ended.isna().any() else ended.astype(int)
    return table.reset_index(drop=True)


def check_records(records: pd.DataFrame) -> None:
    """Check that records have the columns that results are made from, numbers where they belong, and known names.

    Raises:
        ValueError: naming what is wrong.
    """
    absent = sorted({*NEVER_EMPTY, COUNTED} - set(records))
    if absent:
        raise ValueError(f"it has no column {', '.join(absent)}")
    check_numbers(records)
    for column, known, names in (
        ("scenario", ENVIRONMENTS.__contains__, ", ".join(ENVIRONMENTS)),
        ("model", is_model, model_names()),
    ):
        for name in records[column].dropna().unique():
            if not known(name):
                remedy = "if it is your own, --import the module that adds it"
                raise ValueError(f"it holds {column} {name!r}, not one of {names}; {remedy}")


def check_numbers(table: pd.DataFrame) -> None:
    """Check that a table of steps or episodes has numbers where they belong, within their possible ranges.

    All columns but `TEXTS` hold numbers; cells may be empty in those that are not `NEVER_EMPTY`.

    Raises:
        ValueError: naming what is wrong, and where.
    """
    for name in table.columns.difference(TEXTS):
        if pd.api.types.infer_dtype(table[name]) not in ("integer", "floating", "boolean", "empty"):
            raise ValueError(f"it has texts where numbers belong, in column {name}")
        signed = name == "reward" or name.startswith(("gain_", "robot_", "human_"))
        share = name.startswith("share_") or name in ("collision", "success", "late", "way_out")
        least, most = -LARGEST if signed else 0, 1 if share else 2**63 - 1 if name in ("seed", "step") else LARGEST
        wrong = table[~table[name].astype(float).between(least, most)]
        if name not in NEVER_EMPTY:
            wrong = wrong.dropna(subset=name)
        for row in wrong[:1].to_dict("records"):
            where = f"{row['controller']} with seed {row['seed']}"
            raise ValueError(f"{name} of {where} is {row[name]}; it must be from {least:g} to {most:g}")


def one_episode(records: pd.DataFrame, scenario: str, controller: str, seed: int) -> pd.DataFrame:
    """Return the records of one episode, in the order of its steps.

    Raises:
        ValueError: if there are none.
    """
    chosen = records.query("scenario == @scenario and controller == @controller and seed == @seed")
    if chosen.empty:
        raise ValueError(f"there is no episode of {controller!r} in {scenario!r} with seed {seed} in these records")
    return chosen.sort_values("step")


def common_seeds(records: pd.DataFrame, scenario: str, controllers: Sequence[str]) -> list[int]:
    """Return the seeds of the episodes that all of these controllers, one at least, have driven, ascending."""
    rows = records.query("scenario == @scenario and controller in @controllers")
    driven = rows.groupby("seed")["controller"].nunique()
    return driven.index[driven == len(set(controllers))].tolist()
