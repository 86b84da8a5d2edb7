"""Summarise records: a row per scenario and controller, with intervals."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from ms_highway.control.fallback import BRAKING, LATE, PREVIOUS_PLAN, STATUSES, WAY_OUT
from ms_highway.envs.short_names import controller_config
from ms_highway.experiments.records import count_column, models_of, share_column
from ms_highway.planning.human_models import known_models

CONFIDENCE = 0.9
FAILED = STATUSES[PREVIOUS_PLAN], STATUSES[BRAKING]


def summary(records: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scenario and controller, in the order of the records.

    Columns: ``kind``, the type of the controller, and ``price``, its lambda; ``episodes``; ``reward`` per step with
    ``reward_low`` and ``reward_high``, the 90 % interval of the mean over episodes (Student's t), and ``reward_std``
    over episodes; ``planning_ms`` and ``decision_ms`` per step as measured; ``counted_ms`` per step, planning at the
    seconds T(M) that decisions count, empty where one is not known; ``share_MODEL`` of steps; ``collision_episodes``,
    in which the robot collided at least once; ``fallbacks``, steps whose plan failed, of all episodes together;
    ``cycle_ms_p50`` and ``cycle_ms_p99``, quantiles of planning and deciding together; ``late`` and ``way_out``, shares
    of the steps that the robot drove with an old plan because the new one was late, and to keep a way out. Where
    scenarios have several humans: ``success``, the share of the episodes in which the robot succeeded, and
    ``humans_MODEL``, how many each rung above the first predicts in a step.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.

    Raises:
        ValueError: for an unknown controller.
    """
    models = known_models(records["model"].unique())
    counts = [count_column(name) for name in models_of(records, count_column)]

    def row(steps: pd.DataFrame) -> dict[str, Any]:
        episodes = steps.groupby("seed")
        cycles = 1e3 * (steps["planning_seconds"] + steps["decision_seconds"])
        row = {
            "planning_ms": 1e3 * steps["planning_seconds"].mean(),
            "counted_ms": 1e3 * steps["counted_seconds"].mean(skipna=False),
            "decision_ms": 1e3 * steps["decision_seconds"].mean(),
            **{share_column(model): (steps["model"] == model).mean() for model in models},
            "collision_episodes": int(episodes["collision"].any().sum()),
            "fallbacks": int(steps["status"].isin(FAILED).sum()),
        }
        if counts:
            last = steps.sort_values("step").groupby("seed")["success"].last()
            row |= {"success": last.astype(float).mean(), **{name: steps[name].mean() for name in counts}}
        return row | {
            "cycle_ms_p50": cycles.median(),
            "cycle_ms_p99": cycles.quantile(0.99),
            "late": (steps["status"] == STATUSES[LATE]).mean(),
            "way_out": (steps["status"] == STATUSES[WAY_OUT]).mean(),
        }

    return _by_controller(records, row)


def sweep_summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scenario and controller: the columns of `summary` that are not measured.

    Args:
        episodes: a row per episode, see `ms_highway.experiments.batch.Batch.episodes_table`.
    """
    means = [column(name) for column in (share_column, count_column) for name in models_of(episodes, column)]
    means += [name for name in ("success", "way_out") if name in episodes]

    def row(some: pd.DataFrame) -> dict[str, Any]:
        return {
            "counted_ms": 1e3 * some["counted_seconds"].mean(skipna=False),
            **{name: some[name].mean() for name in means},
            "collision_episodes": int((some["collisions"] > 0).sum()),
            "fallbacks": int(some["fallbacks"].sum()),
        }

    return _by_controller(episodes, row)


def _by_controller(table: pd.DataFrame, row: Callable[[pd.DataFrame], dict[str, Any]]) -> pd.DataFrame:
    """Return what all controllers have earned, and what a function summarises of the rows of each."""
    rows = []
    for (scenario, controller), some in table.groupby(["scenario", "controller"], sort=False):
        config, rewards = controller_config(controller), some.groupby("seed")["reward"].mean()
        low, high = interval(rewards)
        earned = {
            "scenario": scenario,
            "controller": controller,
            "kind": config["type"],
            "price": config.get("lambda", np.nan),
            "episodes": len(rewards),
            "reward": rewards.mean(),
            "reward_low": low,
            "reward_high": high,
            "reward_std": rewards.std(),
        }
        rows.append({**earned, **row(some)})
    return pd.DataFrame(rows)


def interval(values: pd.Series) -> tuple[float, float]:
    """Return the 90 % interval of the mean, by Student's t; NaN of less than two values."""
    if len(values) < 2:
        return np.nan, np.nan
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values)
    return values.mean() - half, values.mean() + half
