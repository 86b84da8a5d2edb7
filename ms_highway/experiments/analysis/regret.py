"""Compute regret: how far controllers stay behind the best order of models that is known for every start."""

from collections.abc import Sequence

import pandas as pd

from ms_highway.envs.registry import controller_config, fixed_order_types
from ms_highway.experiments.analysis.summary import interval

BEST_PER_START = "best order of each start"
"""Name that `regrets` gives to the best order that was found for every start."""


def best(table: pd.DataFrame, seeds: Sequence[int], price: float) -> pd.DataFrame:
    """Return, by seed, the row of the highest meta-reward, ``r_R - lambda T(M)`` per step, with that in a column.

    It may be that of any controller: its choices are an order of models, too.

    Args:
        table: of `ms_highway.experiments.frontier.Outcomes`.
        seeds: of the starts.
        price: lambda [reward per second].
    """
    rows = table.query("seed in @seeds").reset_index()
    rows["meta_reward"] = rows["reward"] - price * rows["counted_seconds"]
    return rows.loc[rows.groupby("seed")["meta_reward"].idxmax()].set_index("seed")


def regrets(table: pd.DataFrame, controllers: Sequence[str], seeds: Sequence[int], price: float) -> pd.DataFrame:
    """Compute how far controllers stay behind the best order that was found for each start.

    Args:
        table: of `ms_highway.experiments.frontier.Outcomes`.
        controllers: short names; their lambdas may be others than the price.
        seeds: of the starts.
        price: lambda of the meta-reward [reward per second of planning].

    Returns:
        A row per ``controller``, `BEST_PER_START` the last: ``kind``; ``reward`` and ``counted_seconds`` per step, as
        means over starts; ``meta_reward``; ``regret``, and ``regret_low`` and ``regret_high``, the 90 % interval of its
        mean over starts (Student's t). Among the controllers is the order with the highest
        mean meta-reward of those that were tried from every start.

    Raises:
        KeyError: if a controller was not driven from every start.
    """
    found, net = best(table, seeds, price), table["reward"] - price * table["counted_seconds"]
    everywhere = net.unstack("seed")[list(seeds)].dropna().mean(axis=1)
    kinds = everywhere.index.map(lambda name: controller_config(name)["type"])
    names = dict.fromkeys([*controllers, str(everywhere[kinds.isin(fixed_order_types())].idxmax())])
    driven = {name: table.loc[[(name, seed) for seed in seeds]].droplevel("controller") for name in names}
    rows = []
    for name, own in {**driven, BEST_PER_START: found}.items():
        earned = own["reward"] - price * own["counted_seconds"]
        behind = found["meta_reward"] - earned
        row = {"controller": name, "kind": "search" if own is found else controller_config(name)["type"]}
        row |= own[["reward", "counted_seconds"]].mean()
        row |= {"meta_reward": earned.mean(), "regret": behind.mean()}
        rows.append(row | dict(zip(("regret_low", "regret_high"), interval(behind), strict=True)))
    return pd.DataFrame(rows)
