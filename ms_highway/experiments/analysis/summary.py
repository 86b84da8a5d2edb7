"""Summarise records: a row per scenario and controller, with intervals."""

import numpy as np
import pandas as pd
from scipy import stats

from ms_highway.envs.registry import controller_config
from ms_highway.experiments.records import KEYS, count_column, models_of, share_column
from ms_highway.loop.fallback import BRAKING, LATE, PREVIOUS_PLAN, STATUSES, WAY_OUT
from ms_highway.planning.human_models import known_models

CONFIDENCE = 0.9
FAILED = STATUSES[PREVIOUS_PLAN], STATUSES[BRAKING]
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
            `ms_highway.experiments.batch.Batch.episodes_table`, of which nothing was measured.

    Raises:
        ValueError: for an unknown controller.
    """
    table = _marked(records) if "step" in records else records
    means = [column(name) for column in (share_column, count_column) for name in models_of(table, column)]
    means += [name for name in ("success", "late", "way_out") if name in table]
    rows = []
    for (scenario, controller), some in table.groupby(["scenario", "controller"], sort=False):
        config, episodes = controller_config(controller), some.groupby("seed")
        rewards = episodes["reward"].mean()
        low, high = interval(rewards)
        row = {
            "scenario": scenario,
            "controller": controller,
            "kind": config["type"],
            "price": config.get("lambda", np.nan),
            "episodes": len(rewards),
            "reward": rewards.mean(),
            "reward_low": low,
            "reward_high": high,
            "reward_std": rewards.std(),
            **{name: 1e3 * some[column].mean(skipna=False) for name, column in MILLISECONDS.items() if column in some},
            "collision_episodes": int((episodes["collisions"].sum() > 0).sum()),
            "fallbacks": int(some["fallbacks"].sum()),
            **some[means].mean(),
        }
        if "cycle_ms" in some:
            row["cycle_ms_p50"], row["cycle_ms_p99"] = some["cycle_ms"].quantile([0.5, 0.99])
        rows.append(row)
    return pd.DataFrame(rows)


def _marked(steps: pd.DataFrame) -> pd.DataFrame:
    """Return steps with columns whose means and sums a summary has."""
    table = steps.assign(
        **{share_column(model): steps["model"] == model for model in known_models(steps["model"].unique())},
        late=steps["status"] == STATUSES[LATE],
        way_out=steps["status"] == STATUSES[WAY_OUT],
        fallbacks=steps["status"].isin(FAILED),
        collisions=steps["collision"],
        cycle_ms=1e3 * (steps["planning_seconds"] + steps["decision_seconds"]),
    )
    if "success" in table:
        last = table["step"] == table.groupby(KEYS)["step"].transform("max")
        table["success"] = table["success"].where(last).astype(float)
    return table


def interval(values: pd.Series) -> tuple[float, float]:
    """Return the 90 % interval of the mean, by Student's t; NaN of less than two values."""
    if len(values) < 2:
        return np.nan, np.nan
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values)
    return values.mean() - half, values.mean() + half
