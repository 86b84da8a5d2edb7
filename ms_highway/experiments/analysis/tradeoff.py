"""Compare reward with computation."""

import pandas as pd

from ms_highway.envs.controllers import FIXED_ORDERS
from ms_highway.experiments.records import models_of, share_column
from ms_highway.planning.human_models import MODELS

__all__ = ["best_schedules", "coin", "meta_rewards", "reference", "shares"]

DIGITS = 3  # of a share


def reference(summaries: pd.DataFrame, scenario: str) -> str | None:
    """Return the dearest of the fixed models that were compared, by counted planning time; None without any."""
    fixed = summaries[(summaries["scenario"] == scenario) & (summaries["kind"] == "fixed")].dropna(subset="counted_ms")
    return None if fixed.empty else str(fixed.set_index("controller")["counted_ms"].idxmax())


def shares(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Return reward and computation as shares of the `reference`'s.

    Args:
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.

    Returns:
        By controller, ``reward`` and ``computation``: the reward per step, and the planning counted at T(M), over
        those of the reference. Where the reference earns nothing or less, shares of reward mean nothing and are empty.

    Raises:
        ValueError: if no fixed model with a counted time was compared.
    """
    name, rows = reference(summaries, scenario), summaries[summaries["scenario"] == scenario].set_index("controller")
    if name is None:
        raise ValueError(f"no fixed model was compared in {scenario!r}; add {', '.join(MODELS)} to its controllers")
    reward, computation = rows.loc[name, "reward"], rows.loc[name, "counted_ms"]
    earned = rows["reward"] / (reward if reward > 0 else float("nan"))
    return pd.DataFrame({"reward": earned, "computation": rows["counted_ms"] / computation})


def coin(summaries: pd.DataFrame, scenario: str, controller: str) -> str:
    """Return the short name of a random controller with a controller's shares of the models, which looks at nothing.

    What decides well earns more than this with the same planning.

    Args:
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
        controller: its short name.

    Raises:
        ValueError: if the controller was not compared in the scenario.
    """
    rows = summaries[(summaries["scenario"] == scenario) & (summaries["controller"] == controller)]
    if rows.empty:
        raise ValueError(f"{controller!r} was not compared in {scenario!r}; add it to the controllers")
    known = models_of(rows, share_column)
    parts = {name: round(float(rows[share_column(name)].iloc[0]), DIGITS) for name in known}
    most = max(parts, key=lambda name: parts[name])
    parts[most] = round(1 - sum(part for name, part in parts.items() if name != most), DIGITS)
    return "random:" + ",".join(f"{name}={part:g}" for name, part in parts.items() if part)


def best_schedules(summaries: pd.DataFrame, scenario: str, computation: str = "counted_ms") -> pd.DataFrame:
    """Return the rows of the fixed models, schedules and periods that no other beats with the same or less computation.

    They are a yardstick for controllers that decide online: what could be had with an order of models that was fixed
    beforehand.

    Args:
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
        computation: the column that measures it.
    """
    rows = summaries[summaries["scenario"] == scenario]
    known = (
        rows[rows["kind"].isin(FIXED_ORDERS)]
        .dropna(subset=[computation])
        .sort_values([computation, "reward"], ascending=[True, False])
    )
    return known[known["reward"] > known["reward"].cummax().shift(fill_value=float("-inf"))]


def meta_rewards(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Compute the meta-MDP's reward per step, ``r_R - lambda T(M)``, at every lambda that switching was given.

    Args:
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.

    Returns:
        By lambda, ascending: ``switching`` with that lambda; every fixed model by its name; and ``best schedule``, the
        most that any fixed model, schedule or period has at that lambda.
    """
    rows = summaries[summaries["scenario"] == scenario].dropna(subset="counted_ms")
    switching = rows[rows["kind"] == "switching"].set_index("price").sort_index()
    ordered = rows[rows["kind"].isin(FIXED_ORDERS)].set_index("controller")
    seconds = ordered["counted_ms"] / 1e3
    table = pd.DataFrame({"switching": switching["reward"] - switching.index * switching["counted_ms"] / 1e3})
    every = pd.DataFrame({price: ordered["reward"] - price * seconds for price in table.index}).T
    for name in ordered.index[ordered["kind"] == "fixed"]:
        table[name] = every[name]
    return table.assign(**{"best schedule": every.max(axis=1)}).rename_axis("lambda")
