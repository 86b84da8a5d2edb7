"""Summarise records: a row per scenario and controller, with intervals."""

from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from ms_highway.control.fallback import BRAKING, LATE, PREVIOUS_PLAN, STATUSES, WAY_OUT
from ms_highway.envs.crowd.controllers import any_controller
from ms_highway.experiments.records import share_column
from ms_highway.planning.human_models import known_models

__all__ = ["CONFIDENCE", "earned", "interval", "summary"]

CONFIDENCE = 0.9
FAILED = STATUSES[PREVIOUS_PLAN], STATUSES[BRAKING]


def summary(records: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scenario and controller, in the order of the records.

    Columns: ``kind``, the type of the controller, and ``price``, its lambda; ``episodes``; ``reward`` per step with
    ``reward_low`` and ``reward_high``, the 90 % interval of the mean over episodes (Student's t), and ``reward_std``
    over episodes; ``planning_ms`` and ``decision_ms`` per step as measured; ``counted_ms`` per step, planning at the
    seconds T(M) that decisions count, empty where one is not known; ``share_MODEL`` of steps; ``collision_episodes``,
    in which the robot collided at least once; ``fallbacks``, steps whose plan failed, of all episodes together. Among
    several humans, and empty with one: ``success``, the share of the episodes in which the robot succeeded;
    ``humans_turn`` and ``humans_tom``, how many are predicted by these models in a step; ``cycle_ms_p50`` and
    ``cycle_ms_p99``, quantiles of planning and deciding together; ``late`` and ``way_out``, shares of the steps that
    the robot drove with an old plan because the new one was late, and to keep a way out.

    Raises:
        ValueError: for an unknown controller.
    """
    rows, models = [], known_models(records["model"].unique())
    for (scenario, controller), steps in records.groupby(["scenario", "controller"], sort=False):
        rows.append(
            {
                "scenario": scenario,
                **earned(controller, steps.groupby("seed")["reward"].mean()),
                "planning_ms": 1e3 * steps["planning_seconds"].mean(),
                "counted_ms": 1e3 * steps["counted_seconds"].mean(skipna=False),
                "decision_ms": 1e3 * steps["decision_seconds"].mean(),
                **{share_column(model): (steps["model"] == model).mean() for model in models},
                "collision_episodes": int(steps.groupby("seed")["collision"].any().sum()),
                "fallbacks": int(steps["status"].isin(FAILED).sum()),
                **_among_several(steps),
            }
        )
    return pd.DataFrame(rows)


def _among_several(steps: pd.DataFrame) -> dict[str, float]:
    """Return what is summarised of steps among several humans; NaN with one human."""
    names = ("success", "humans_turn", "humans_tom", "cycle_ms_p50", "cycle_ms_p99", "late", "way_out")
    if "success" not in steps or steps["success"].isna().all():
        return dict.fromkeys(names, np.nan)
    success = steps.sort_values("step").groupby("seed")["success"].last().astype(float).mean()
    cycles = 1e3 * (steps["planning_seconds"] + steps["decision_seconds"])
    shares = [(steps["status"] == STATUSES[number]).mean() for number in (LATE, WAY_OUT)]
    counts = [steps[name].mean() for name in names[1:3]]
    return dict(zip(names, [success, *counts, cycles.median(), cycles.quantile(0.99), *shares], strict=True))


def earned(controller: str, rewards: pd.Series) -> dict[str, Any]:
    """Summarise a controller's rewards, each the mean of an episode; see `summary`.

    Raises:
        ValueError: for an unknown controller.
    """
    settings, (low, high) = any_controller(controller), interval(rewards)
    return {
        "controller": controller,
        "kind": settings.type,
        "price": settings.price,
        "episodes": len(rewards),
        "reward": rewards.mean(),
        "reward_low": low,
        "reward_high": high,
        "reward_std": rewards.std(),
    }


def interval(values: pd.Series) -> tuple[float, float]:
    """Return the 90 % interval of the mean, by Student's t; NaN of less than two values."""
    if len(values) < 2:
        return np.nan, np.nan
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * stats.sem(values)
    return values.mean() - half, values.mean() + half
