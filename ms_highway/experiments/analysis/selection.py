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
        beside: the episode from that start of the most expensive fixed model, for comparison; None without such a
            model.
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
    rows = summaries.query("scenario == @scenario")
    names, filmed, dearest = list(rows["controller"]), telling_pair(summaries, scenario), reference(summaries, scenario)
    paper = [name for name in names if name in paper_controllers(scenario)]
    told = [*paper, *filmed, *choosing_controllers(summaries, scenario)] if paper else names[:MOST_CONTROLLERS]
    main = [name for name in names if len(names) <= MOST_CONTROLLERS or name in told]
    shown = rows[rows["kind"].isin(CHOOSING) & rows["controller"].isin(main)]
    several = shown["kind"].nunique() > 1
    deciding = choosing_controllers(shown, scenario) if several else list(shown["controller"])
    driving = [*deciding[:MOST_DECIDING], dearest] if dearest else deciding[:MOST_DECIDING]
    seeds = common_seeds(records, scenario, driving) if deciding else []
    episodes = [one_episode(records, scenario, name, seeds[0]) for name in driving if seeds]
    beside = episodes.pop() if episodes and dearest else None
    return Selection(main, filmed, next(iter(common_seeds(records, scenario, filmed)), 0), episodes, beside)


def select_of_several(several: Sequence[Results]) -> dict[str, Selection]:
    """Select what is shown of every scenario of several comparisons, by its name.

    Figures and films are of the first comparison that has the scenario; controllers of the others are added to the top
    of the table as long as there is room.
    """
    selections: dict[str, Selection] = {}
    for results in several:
        rows = results.summaries
        for scenario in results.scenarios:
            if scenario in selections:
                main = [*selections[scenario].main, *rows.loc[rows["scenario"] == scenario, "controller"]]
                room = max(MOST_CONTROLLERS, len(selections[scenario].main))
                selections[scenario] = replace(selections[scenario], main=list(dict.fromkeys(main))[:room])
            else:
                selections[scenario] = select(results.records, rows, scenario)
    return selections


def telling_pair(summaries: pd.DataFrame, scenario: str) -> list[str]:
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
    rows = summaries[(summaries["scenario"] == scenario) & summaries["kind"].isin(CHOOSING)].set_index("controller")
    usual = named_controller(paper_controllers(scenario)[-1]).price
    chosen = {kind: (own["price"] != usual) * (1 + own["price"]) for kind, own in rows.groupby("kind")}
    return [str(chosen[kind].astype(float).idxmin()) for kind in sorted(chosen, key=lambda kind: kind != PREFERRED)]
