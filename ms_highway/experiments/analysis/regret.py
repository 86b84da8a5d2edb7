"""Compute regret: how far controllers stay behind the best order of models that is known for every start."""

from collections.abc import Mapping, Sequence
from math import isclose
from typing import NamedTuple

import numpy as np
import pandas as pd

from ms_highway.envs.controllers import CHOOSING, FIXED_ORDERS
from ms_highway.envs.short_names import named_controller
from ms_highway.experiments.analysis.summary import interval

__all__ = [
    "BEST_PER_START",
    "BestControllers",
    "best",
    "best_controllers",
    "best_for_all",
    "frontier_curve",
    "meta_reward",
    "regrets",
    "remarks",
]

BEST_PER_START = "best order of each start"
"""Name that `regrets` gives to the best order that was found for every start."""


CURVE_PRICES = np.geomspace(1e-3, 1e3, 121)  # reward per second


class BestControllers(NamedTuple):
    """The controllers of the least regret in a scenario, at one price.

    Attributes:
        order: of the fixed models and fixed orders.
        switching: with the best lambda for the scenario; None without any. Or of another kind that has a lambda.
        common: the same with the lambda of the least mean regret over all scenarios; None without any.
    """

    order: str
    switching: str | None
    common: str | None


def meta_reward(episodes: pd.DataFrame, price: float) -> pd.Series:
    """Return the meta-MDP's reward per step, ``r_R - lambda T(M)``, of each row of a table of episodes."""
    return episodes["reward"] - price * episodes["counted_seconds"]


def best(table: pd.DataFrame, seeds: Sequence[int], price: float) -> pd.DataFrame:
    """Return, by seed, the row of the highest meta-reward, with that in a column ``meta_reward``.

    It may be that of any controller: its choices are an order of models, too.

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
    """Return the order with the highest mean meta-reward among those that were tried from every start; see `best`."""
    earned = meta_reward(table, price).unstack("seed")[list(seeds)].dropna()
    fixed = [name for name in earned.index if named_controller(name).type in FIXED_ORDERS]
    return str(earned.loc[fixed].mean(axis=1).idxmax())


def regrets(
    table: pd.DataFrame,
    controllers: Sequence[str],
    seeds: Sequence[int],
    price: float,
    agents: Mapping[str, Mapping[int, str]] | None = None,
) -> pd.DataFrame:
    """Compute how far controllers stay behind the best order that was found for each start.

    Args:
        table: of `ms_highway.experiments.frontier.Outcomes`.
        controllers: short names; their lambdas may be others than the price.
        seeds: of the starts.
        price: lambda of the meta-reward [reward per second of planning].
        agents: by name of an agent and seed, the short name of the order that it chose; its kind is ``agent``.

    Returns:
        By controller and agent, `BEST_PER_START` the last: ``kind``; ``reward`` and ``counted_seconds`` per step, means
        over starts; ``meta_reward``; ``regret``, and ``regret_low`` and ``regret_high``, the 90 % interval of its mean
        over starts (Student's t), empty where all are equal. `best_for_all` is among the controllers.

    Raises:
        KeyError: if a controller was not driven from every start.
    """
    found, rows = best(table, seeds, price), {}
    driven = {name: dict.fromkeys(seeds, name) for name in [*controllers, best_for_all(table, seeds, price)]}
    kinds = {name: named_controller(name).type for name in driven}
    driven |= {name: dict(orders) for name, orders in (agents or {}).items()}
    episodes = {name: table.loc[[(orders[seed], seed) for seed in seeds]] for name, orders in driven.items()}
    for name, whole in [*episodes.items(), (BEST_PER_START, found)]:
        own = whole.droplevel("controller") if name in driven else whole
        kind = kinds.get(name, "agent") if name in driven else "search"
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


def best_controllers(behind: pd.DataFrame, scenario: str, kind: str = "switching") -> BestControllers:
    """Find the controllers of the least regret in a scenario.

    Args:
        behind: rows of `regrets` at one price, of all scenarios, with columns ``controller`` and ``scenario``.
        scenario: its name.
        kind: of the controllers that have a lambda.
    """
    own = behind[behind["scenario"] == scenario].set_index("controller")
    order = str(own.loc[own["kind"].isin(FIXED_ORDERS), "regret"].idxmin())
    switching = behind[behind["kind"] == kind].pivot(index="controller", columns="scenario", values="regret")
    if switching.empty:
        return BestControllers(order, None, None)
    return BestControllers(order, str(switching[scenario].idxmin()), str(switching.mean(axis=1).idxmin()))


def remarks(behind: pd.DataFrame, scenario: str, price: float) -> dict[str, str]:
    """Select the controllers of a scenario that a table shows; return what is said of each.

    Of controllers that have a lambda, these are of each kind the one whose lambda is the price, the one with the best
    lambda for the scenario, and the one with the best lambda that all scenarios have in common.

    Args:
        behind: rows of `regrets` at one price, of all scenarios, with columns ``controller`` and ``scenario``.
        scenario: its name.
        price: at which they are judged.
    """
    kinds = behind[behind["scenario"] == scenario].set_index("controller")["kind"]
    priced = [kind for kind in CHOOSING if kind in set(kinds)]
    said: dict[str, list[str]] = {name: [] for name in kinds.index[~kinds.isin([*priced, "search"])]}
    said[best_controllers(behind, scenario).order].append("best for all starts")
    for kind in priced:
        _, here, common = best_controllers(behind, scenario, kind)
        chosen = [(here, "best lambda"), (common, "also common" if common == here else "best common lambda")]
        own = [name for name in kinds.index[kinds == kind] if isclose(named_controller(name).price, price)]
        for name, remark in [*((name, "lambda = price") for name in own), *chosen]:
            said.setdefault(str(name), []).append(remark)
    return {name: ", ".join(parts) for name, parts in said.items()} | {BEST_PER_START: ""}


def frontier_curve(table: pd.DataFrame, seeds: Sequence[int]) -> pd.DataFrame:
    """Return mean ``reward`` and ``counted_seconds`` of the `best` orders, from price to price."""
    return pd.DataFrame([best(table, seeds, price)[["reward", "counted_seconds"]].mean() for price in CURVE_PRICES])
