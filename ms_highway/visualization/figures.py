"""The figures of a comparison: which there are, and what they show."""

import pandas as pd
from matplotlib.figure import Figure

from ms_highway.experiments.comparison import paper_controllers
from ms_highway.experiments.records import common_seeds, one_episode
from ms_highway.experiments.tradeoff import reference
from ms_highway.visualization.comparison import bars, timeline
from ms_highway.visualization.decisions import decisions
from ms_highway.visualization.tradeoff import curve

__all__ = ["CAPTIONS", "few", "figures"]

MOST_CONTROLLERS = 8  # in bars and timelines
FEWEST_LAMBDAS = 3  # that make a curve
EPISODES_BESIDE = 2  # whose decisions are drawn

CAPTIONS = {
    "bars": "Reward and time per step of each controller. Whiskers are the 90 % intervals of the mean over episodes; "
    "hatched is the time of deciding about the model.",
    "timeline": "Computation along the episode, as the mean over episodes. Below, which model was in use at every step "
    "of every episode of the controllers that switch.",
    "curve": "Reward against computation: on the left, planning as decisions count it, at T(M); on the right, planning "
    "and deciding as measured. Whiskers are the 90 % intervals. Switching is labelled by lambda. Where "
    "schedules were compared, a dashed line joins the best of all that was fixed, chosen by these very episodes. "
    "Crosses draw their models at random.",
    "decisions": "Decisions in single episodes. Above, the estimated net gain of switching to each model, before the "
    "step that it is drawn at; one above zero is taken. Below, the reward. The background is the model in use.",
}
"""What the figures of `figures` show."""


def few(summaries: pd.DataFrame, scenario: str) -> pd.DataFrame:
    """The summary of a scenario; of more than 8 controllers, of those that the paper compares, or of the first 8."""
    rows = summaries[summaries["scenario"] == scenario]
    if len(rows) <= MOST_CONTROLLERS:
        return rows
    paper = rows["controller"].isin(paper_controllers(scenario))
    return rows[paper] if paper.any() else rows[:MOST_CONTROLLERS]


def figures(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> dict[str, Figure]:
    """All figures of a scenario, by the names that `CAPTIONS` explains.

    Reward and computation are a curve where there are three lambdas, and else bars; bars, timeline and decisions are of
    a `few` controllers.
    """
    rows = few(summaries, scenario)
    driven = records[records["controller"].isin(rows["controller"])]
    lambdas = summaries.loc[summaries["scenario"] == scenario, "price"].nunique()
    outcome = {"curve": curve(summaries, scenario)} if lambdas >= FEWEST_LAMBDAS else {"bars": bars(rows, scenario)}
    decided = _decisions(records, rows, reference(summaries, scenario), scenario)
    return {**outcome, "timeline": timeline(driven, scenario), **decided}


def _decisions(records: pd.DataFrame, rows: pd.DataFrame, dearest: str | None, scenario: str) -> dict[str, Figure]:
    """Decisions in the first episode that the switching controllers have in common; nothing without such."""
    switching = list(rows.loc[rows["kind"] == "switching", "controller"])[:EPISODES_BESIDE]
    names = switching if dearest is None else [*switching, dearest]
    seeds = common_seeds(records, scenario, names) if switching else []
    if not seeds:
        return {}
    episodes = {name: one_episode(records, scenario, name, seeds[0]) for name in names}
    beside = None if dearest is None else episodes[dearest]
    return {"decisions": decisions([episodes[name] for name in switching], beside)}
