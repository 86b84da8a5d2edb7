"""Compare reward with computation."""

import pandas as pd

from ms_highway.envs.controllers import CHOOSING, FIXED_ORDERS


def reference(summaries: pd.DataFrame, scenario: str) -> str | None:
    """Return the most expensive of the fixed models that were compared, by counted planning time; None without any."""
    fixed = summaries[(summaries["scenario"] == scenario) & (summaries["kind"] == "fixed")].dropna(subset="counted_ms")
    return None if fixed.empty else str(fixed.set_index("controller")["counted_ms"].idxmax())


def best_schedules(summaries: pd.DataFrame, scenario: str, computation: str = "counted_ms") -> pd.DataFrame:
    """Return the rows of the fixed models, schedules and periods that no other beats with the same or less computation.

    They are a yardstick for controllers that decide online: what could be had with an order of models that was fixed
    beforehand.

    Args:
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
        computation: the column that measures it.
    """
    rows = summaries.query("scenario == @scenario")
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
    rows = summaries.query("scenario == @scenario").dropna(subset="counted_ms")
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
