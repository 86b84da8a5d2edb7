"""Compare reward with computation."""

import pandas as pd

from ms_highway.envs.controllers import CHOOSING, FIXED_ORDERS
from ms_highway.experiments.records import models_of, share_column
from ms_highway.planning.human_models import MODELS

__all__ = ["best_schedules", "choosing", "coin", "meta_rewards", "reference", "shares"]

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


def choosing(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the rows of a summary that choose models online, in the order of lambda.

    They are by what chooses: the kind, such as ``switching``, with the file of values where one is named.
    """
    online = rows[rows["kind"].isin(CHOOSING)]
    names = online["controller"].str.replace(r"^(\w+):[^:]*", r"\1", regex=True)
    return {str(name): own.sort_values("price") for name, own in online.groupby(names, sort=False)}


def meta_rewards(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """Compute the meta-MDP's reward per step, ``r_R - lambda T(M)``, at every lambda that models were chosen with.

    Args:
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.

    Returns:
        By lambda, ascending: each of `choosing` with that lambda, such as ``switching``, NaN where it was not compared;
        every fixed model by its name; and ``best schedule``, the most that any fixed model, schedule or period has.
    """
    rows = summaries[summaries["scenario"] == scenario].dropna(subset="counted_ms")
    online = {name: own.set_index("price") for name, own in choosing(rows).items()}
    ordered = rows[rows["kind"].isin(FIXED_ORDERS)].set_index("controller")
    seconds = ordered["counted_ms"] / 1e3
    table = pd.DataFrame(
        {name: own["reward"] - own.index * own["counted_ms"] / 1e3 for name, own in online.items()}
    ).sort_index()
    every = pd.DataFrame({price: ordered["reward"] - price * seconds for price in table.index}).T
    for name in ordered.index[ordered["kind"] == "fixed"]:
        table[name] = every[name]
    return table.assign(**{"best schedule": every.max(axis=1)}).rename_axis("lambda")
