"""Which controllers of a comparison are shown, where there is no room for all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import pandas as pd

from ms_highway.envs.controllers import CHOOSING
from ms_highway.envs.short_names import named_controller
from ms_highway.experiments.analysis.tradeoff import reference
from ms_highway.experiments.comparison import paper_controllers
from ms_highway.experiments.records import common_seeds, one_episode
from ms_highway.experiments.results import Results

__all__ = ["Selection", "choosing_controllers", "select", "select_of_several", "telling_pair"]

MOST_CONTROLLERS = 8  # in bars and timelines
MOST_DECIDING = 2  # whose decisions are drawn beside each other
PREFERRED = "learned"  # among the kinds that choose online


@dataclass(frozen=True)
class Selection:
    """The controllers of one scenario that are shown, by short name.

    Attributes:
        main: in bars and timelines, and at the top of tables.
        filmed: the one or two that are filmed, see `telling_pair`.
        film_seed: of the episode that is filmed, the first that all of them have driven.
        deciding: the episodes of controllers that choose online whose decisions are drawn, all from the same start:
            the first two, or where there are several kinds, one of each of two kinds.
        beside: the episode from that start of the dearest fixed model, for comparison; None without such a model.
    """

    main: list[str]
    filmed: list[str]
    film_seed: int
    deciding: list[pd.DataFrame]
    beside: pd.DataFrame | None


def select(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> Selection:
    """Select what is shown of a scenario; of more than 8 controllers, mainly the paper's, or else the first 8.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.analysis.summary.summary`.
        scenario: its name.
    """
    rows = summaries[summaries["scenario"] == scenario]
    names = list(rows["controller"])
    paper = [name for name in names if name in paper_controllers(scenario)]
    main = names if len(names) <= MOST_CONTROLLERS else paper or names[:MOST_CONTROLLERS]
    filmed = telling_pair(summaries, scenario)
    dearest = reference(summaries, scenario)
    shown = rows[rows["kind"].isin(CHOOSING) & rows["controller"].isin(main)]
    deciding = list(shown["controller"]) if shown["kind"].nunique() < 2 else choosing_controllers(shown, scenario)
    deciding = deciding[:MOST_DECIDING]
    driving = [*deciding, *([] if dearest is None else [dearest])]
    seeds = common_seeds(records, scenario, driving) if deciding else []
    episodes = {name: one_episode(records, scenario, name, seeds[0]) for name in driving if seeds}
    return Selection(
        main,
        filmed,
        next(iter(common_seeds(records, scenario, filmed)), 0),
        [episodes[name] for name in deciding if name in episodes],
        episodes.get(dearest) if dearest else None,
    )


def select_of_several(several: Sequence[Results]) -> dict[str, Selection]:
    """Select what is shown of every scenario of several comparisons, by its name.

    Figures and films are of the first comparison that has the scenario; controllers of the others are added to the top
    of the table as long as there is room.
    """
    selections: dict[str, Selection] = {}
    for results in several:
        for scenario in results.scenarios:
            if scenario not in selections:
                selections[scenario] = select(results.records, results.summaries, scenario)
                continue
            rows, main = results.summaries, selections[scenario].main
            further = [name for name in rows.loc[rows["scenario"] == scenario, "controller"] if name not in main]
            room = max(0, MOST_CONTROLLERS - len(main))
            selections[scenario] = replace(selections[scenario], main=[*main, *further[:room]])
    return selections


def telling_pair(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return the two controllers of a scenario that are most informative side by side.

    These are the fixed model of the highest mean reward, and the first of `choosing_controllers`; where either is
    missing, the first two; the only one where there is one.
    """
    rows = summaries[summaries["scenario"] == scenario].set_index("controller")
    fixed, choosing = rows[rows["kind"] == "fixed"], choosing_controllers(summaries, scenario)
    if fixed.empty or not choosing:
        return list(rows.index[:2])
    return [str(fixed["reward"].idxmax()), choosing[0]]


def choosing_controllers(summaries: pd.DataFrame, scenario: str) -> list[str]:
    """Return a controller of each kind that chooses online, learned values first.

    It is the one at the paper's conservative lambda or else at the smallest.
    """
    rows = summaries[summaries["scenario"] == scenario].set_index("controller")
    usual = named_controller(paper_controllers(scenario)[-1]).price
    chosen = []
    for kind in sorted(CHOOSING, key=lambda kind: kind != PREFERRED):
        prices = rows.loc[rows["kind"] == kind, "price"].astype(float)
        if len(prices):
            chosen.append(str(prices.index[prices == usual][0] if (prices == usual).any() else prices.idxmin()))
    return chosen
