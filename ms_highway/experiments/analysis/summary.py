"""Summarise records: a row per scenario and controller, with intervals."""

import numpy as np
import pandas as pd
from scipy import stats

from ms_highway.envs.registry import controller_config
from ms_highway.experiments.records import models_of, per_episode

CONFIDENCE = 0.9
MILLISECONDS = {"planning_ms": "planning_seconds", "counted_ms": "counted_seconds", "decision_ms": "decision_seconds"}


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
        records: a row per step, see `ms_highway.experiments.records.columns`; or per simulated episode, see
            `ms_highway.experiments.records.per_episode`, of which nothing was measured.

    Raises:
        ValueError: for an unknown controller.
    """
    table, by = per_episode(records) if "step" in records else records, ["scenario", "controller"]
    shares = [f"{what}_{name}" for what in ("share", "humans") for name in models_of(table, what)]
    shares += [name for name in ("success", "late", "way_out") if name in table]
    rows = []
    for (scenario, controller), some in table.groupby(by, sort=False):
        config, rewards = controller_config(controller), some["reward"]
        low, high = interval(rewards)
        row = {"scenario": scenario, "controller": controller}
        row |= {"kind": config["type"], "price": config.get("lambda", np.nan), "episodes": len(some)}
        row |= {"reward": rewards.mean(), "reward_low": low, "reward_high": high, "reward_std": rewards.std()}
        row |= {name: 1e3 * some[column].mean(skipna=False) for name, column in MILLISECONDS.items() if column in some}
        row |= {"collision_episodes": (some["collisions"] > 0).sum(), "fallbacks": some["fallbacks"].sum()}
        rows.append(row | dict(some[shares].mean()))
    summaries = pd.DataFrame(rows)
    if "planning_seconds" in records:
        cycles = records.assign(ms=1e3 * (records["planning_seconds"] + records["decision_seconds"])).groupby(by)["ms"]
        quantiles = pd.DataFrame({"cycle_ms_p50": cycles.quantile(0.5), "cycle_ms_p99": cycles.quantile(0.99)})
        summaries = summaries.join(quantiles, on=by)
    return summaries


def interval(values: pd.Series) -> tuple[float, float]:
    """Return the 90 % interval of the mean, by Student's t; NaN of less than two values."""
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * values.sem()
    return values.mean() - half, values.mean() + half
