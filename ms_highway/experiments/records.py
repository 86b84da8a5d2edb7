"""Define the columns of records of steps, check and select records, and summarise them by episode."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ms_highway.loop.fallback import BRAKING, LATE, PREVIOUS_PLAN, STATUSES, WAY_OUT
from ms_highway.planning.ladders import known_models

KEYS = ["scenario", "controller", "seed"]
"""Columns that say which episode a step is of."""

MEASURED = ("planning_seconds", "decision_seconds", "compile_seconds")
"""Columns of times as they were measured, which a simulation does not have."""

COUNTED = "counted_seconds"
NEEDED = [*KEYS, "step", "model", "status", "reward", "collision", *MEASURED[:2]]
"""Columns of live steps that must be filled in every row."""

TEXTS = ("scenario", "controller", "model", "status")
FAILED = STATUSES[PREVIOUS_PLAN], STATUSES[BRAKING]
STATES = [f"{car}_{name}" for car in ("robot", "human") for name in ("x", "y", "heading", "speed")]
"""Columns of the states of the first two cars."""


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
    steps = ["step", "model", "reward", "collision", planning, COUNTED, decision, compiling, "status"]
    gains = [f"gain_{name}" for name in known_models(rungs)]
    several = [] if above is None else [*dict.fromkeys(f"humans_{name}" for name in above), "success"]
    return [*KEYS, *steps, *gains, *STATES, *several]


def by_column(gains: Mapping, states: Any) -> dict:
    """Return gains by model, and the states [..., cars, 4] of the first two cars, by the columns of records."""
    first = np.moveaxis(states[..., :2, :], (-2, -1), (0, 1)).reshape(len(STATES), *np.shape(states)[:-2])
    return {f"gain_{name}": gain for name, gain in gains.items()} | dict(zip(STATES, first, strict=True))


def models_of(table: pd.DataFrame, what: str) -> list[str]:
    """Return the known models that a table has columns ``WHAT_MODEL`` of, such as ``gain``, cheapest first."""
    names = {str(name).removeprefix(f"{what}_") for name in table if str(name).startswith(f"{what}_")}
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
    shares = {f"share_{name}": steps["model"] == name for name in models}
    shares["way_out"] = steps["status"] == STATUSES[WAY_OUT]
    measured = [name for name in MEASURED[:2] if name in steps]
    if measured:
        shares["late"] = steps["status"] == STATUSES[LATE]
    sums = {"collisions": steps["collision"], "fallbacks": steps["status"].isin(FAILED)}
    counts = [f"humans_{name}" for name in models_of(steps, "humans")]
    episodes = steps.assign(**shares, **sums).groupby((steps["step"] == 0).cumsum())
    means = episodes[["reward", COUNTED, *measured, *counts, *shares]]
    known = means.count().eq(episodes.size(), axis=0)
    table = episodes[KEYS].first().join(means.mean().where(known)).join(episodes[list(sums)].sum())
    if "success" in steps:
        ended = episodes["success"].last()  # empty where there is one human
        table["success"] = ended if ended.isna().any() else ended.astype(int)
    return table.reset_index(drop=True)


def check_table(table: pd.DataFrame, needed: Sequence[str] = ()) -> None:
    """Check that a table of steps or episodes holds the needed columns, and finite numbers except in `TEXTS`.

    Args:
        table: the table.
        needed: columns that must be there, beside those of every table. Those of `NEEDED` must have no empty cell.

    Raises:
        ValueError: naming what is wrong, and where.
    """
    absent = sorted({*KEYS, "reward", COUNTED, *needed} - {*table})
    if absent:
        raise ValueError(f"it has no column {', '.join(absent)}")
    for name in table.columns.difference(TEXTS):
        numbers = pd.to_numeric(table[name], errors="coerce").astype(float)
        wrong = ~np.isfinite(numbers) & (table[name].notna() | (name in NEEDED))
        for row in table[wrong][:1].to_dict("records"):
            where = f"{name} of {row['controller']} with seed {row['seed']}"
            raise ValueError(f"{where} is {row[name]}; it must be a finite number")


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
