"""Regret: how far controllers stay behind the best order of models that is known for every start."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from ms_highway.envs.drivers import controller_config
from ms_highway.experiments.summary import interval

__all__ = ["EACH", "best", "best_for_all", "meta_reward", "regrets"]

EACH = "best order of each start"
"""What `regrets` calls the best that was found."""


def meta_reward(episodes: pd.DataFrame, price: float) -> pd.Series:
    """The meta-MDP's reward per step, ``r_R - lambda T(M)``, of each row of `experiments.simulated.summarised`."""
    return episodes["reward"] - price * episodes["counted_seconds"]


def best(table: pd.DataFrame, seeds: Sequence[int], price: float) -> pd.DataFrame:
    """By seed, the row of the highest meta-reward, with that in a column ``meta_reward``.

    It may be that of a switching controller, whose choices are an order of models, too.

    Args:
        table: of `ms_highway.experiments.frontier.Outcomes`.
        seeds: of the starts.
        price: lambda [reward per second].
    """
    rows = table.reset_index()
    rows = rows[rows["seed"].isin(seeds)].reset_index(drop=True)
    rows["meta_reward"] = meta_reward(rows, price)
    return rows.loc[rows.groupby("seed")["meta_reward"].idxmax()].set_index("seed")


def best_for_all(table: pd.DataFrame, seeds: Sequence[int], price: float) -> str:
    """The order with the highest mean meta-reward among those that were tried from every start; see `best`."""
    earned = meta_reward(table, price).unstack("seed")[list(seeds)].dropna()
    fixed = [name for name in earned.index if controller_config(name)["type"] in ("fixed", "schedule")]
    return str(earned.loc[fixed].mean(axis=1).idxmax())


def regrets(table: pd.DataFrame, controllers: Sequence[str], seeds: Sequence[int], price: float) -> pd.DataFrame:
    """How far controllers stay behind the best order that was found for each start.

    Args:
        table: of `ms_highway.experiments.frontier.Outcomes`.
        controllers: short names; a switching controller may have decided with another lambda than the price.
        seeds: of the starts.
        price: lambda of the meta-reward [reward per second].

    Returns:
        By controller, `EACH` and `best_for_all` the last: ``kind``; ``reward`` and ``counted_seconds`` per step, means
        over starts; ``meta_reward``; ``regret``, and ``regret_low`` and ``regret_high``, the 90 % interval of its mean
        over starts (Student's t), empty where all are equal.

    Raises:
        KeyError: if a controller was not driven from every start.
    """
    found, rows = best(table, seeds, price), {}
    drivers = {name: controller_config(name)["type"] for name in controllers}
    drivers.setdefault(best_for_all(table, seeds, price), "schedule")
    for name, kind in [*drivers.items(), (EACH, "search")]:
        own = found if name == EACH else table.loc[[(name, seed) for seed in seeds]].droplevel("controller")
        behind = found["meta_reward"] - meta_reward(own, price)
        low, high = interval(behind) if behind.std() > 0 else (np.nan, np.nan)
        rows[name] = {
            "kind": kind,
            **own[["reward", "counted_seconds"]].mean(),
            "meta_reward": meta_reward(own, price).mean(),
            "regret": behind.mean(),
            "regret_low": low,
            "regret_high": high,
        }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("controller")
