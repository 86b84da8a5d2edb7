"""Select the controllers of a comparison that are shown, where there is no room for all."""

import pandas as pd

from ms_highway.envs.registry import priced_types


def choosing_controllers(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return a controller of each kind that chooses online, the one at the smallest lambda, in the table's order."""
    rows = summaries[(summaries["scenario"] == scenario) & summaries["kind"].isin(priced_types())]
    return rows.loc[rows.groupby("kind", sort=False)["price"].idxmin(), "controller"].to_list()


def most_informative_pair(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return the two controllers of a scenario that are most informative side by side.

    These are the fixed model of the highest mean reward, and the first of `choosing_controllers`; where either is
    missing, the first of the others; the only one where there is one.
    """
    rows = summaries.query("scenario == @scenario")
    best = rows.query("kind == 'fixed'").nlargest(1, "reward")["controller"]
    return list(dict.fromkeys([*best, *choosing_controllers(summaries, scenario)[:1], *rows["controller"]]))[:2]
