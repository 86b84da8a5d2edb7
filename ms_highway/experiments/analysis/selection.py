"""Select the controllers of a comparison that are shown, where there is no room for all."""

import pandas as pd

from ms_highway.envs.registry import controller_settings, priced_types
from ms_highway.experiments.comparison import paper_controllers

MOST_CONTROLLERS = 8  # in bars and timelines
PREFERRED = "learned"  # among the kinds that choose online


def main_controllers(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return all controllers of a scenario; of more than 8, mainly the paper's, or else the first 8."""
    names = list(summaries.loc[summaries["scenario"] == scenario, "controller"])
    paper = [name for name in names if name in paper_controllers(scenario)]
    if len(names) <= MOST_CONTROLLERS or not paper:
        return names[:MOST_CONTROLLERS]
    shown = {*paper, *most_informative_pair(summaries, scenario), *choosing_controllers(summaries, scenario)}
    return [name for name in names if name in shown]


def most_informative_pair(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return the two controllers of a scenario that are most informative side by side.

    These are the fixed model of the highest mean reward, and the first of `choosing_controllers`; where either is
    missing, the first two; the only one where there is one.
    """
    rows = summaries.query("scenario == @scenario").set_index("controller")
    fixed, choosing = rows.query("kind == 'fixed'"), choosing_controllers(summaries, scenario)
    return list(rows.index[:2]) if fixed.empty or not choosing else [str(fixed["reward"].idxmax()), choosing[0]]


def choosing_controllers(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return a controller of each kind that chooses online, learned values first.

    It is the one at the paper's conservative lambda or else at the smallest.
    """
    usual = controller_settings(paper_controllers(scenario)[-1]).price
    rows = summaries[(summaries["scenario"] == scenario) & summaries["kind"].isin(priced_types())]
    rows = rows.assign(unusual=rows["price"] != usual, late=rows["kind"] != PREFERRED)
    rows = rows.sort_values(["late", "kind", "unusual", "price"], kind="stable")
    return rows.drop_duplicates("kind")["controller"].to_list()
