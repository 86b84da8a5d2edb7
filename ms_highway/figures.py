"""The figures of a comparison: which there are, and what they show."""

import pandas as pd
from matplotlib.figure import Figure

from ms_highway.experiment import paper_controllers
from ms_highway.report import bars, timeline
from ms_highway.story import common_seeds, decisions, one_episode
from ms_highway.tradeoff import curve, reference

__all__ = ["CAPTIONS", "figures"]

MOST_CONTROLLERS = 8  # in bars and timelines
EPISODES_BESIDE = 2  # whose decisions are drawn

CAPTIONS = {
    "bars": "Reward and time per step of each controller. Whiskers are the 90 % intervals of the mean over episodes; "
    "hatched is the time of deciding about the model.",
    "timeline": "Computation along the episode, as the mean over episodes. Below, which model was in use at every step "
    "of every episode of the controllers that switch.",
    "curve": "Reward against computation: on the left, planning as decisions count it, at T(M); on the right, planning "
    "and deciding as measured. Whiskers are the 90 % intervals. Switching is labelled by lambda. Where "
    "schedules were compared, a dashed line joins the best of all that was fixed, chosen by these very episodes.",
    "decisions": "Decisions in single episodes. Above, the estimated net gain of switching to each model, before the "
    "step that it is drawn at; one above zero is taken. Below, the reward. The background is the model in use.",
}
"""What the figures of `figures` show."""


def figures(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> dict[str, Figure]:
    """All figures of a scenario, by the names that `CAPTIONS` explains.

    Of more than 8 controllers, bars, timeline and decisions show those that the paper compares, or the first 8.
    """
    rows = summaries[summaries["scenario"] == scenario]
    if len(rows) > MOST_CONTROLLERS:
        paper = rows["controller"].isin(paper_controllers(scenario))
        rows = rows[paper] if paper.any() else rows[:MOST_CONTROLLERS]
    few = records[records["controller"].isin(rows["controller"])]
    drawn = {
        "bars": bars(rows, scenario),
        "timeline": timeline(few, scenario),
        "curve": curve(summaries, scenario),
    }
    return {**drawn, **_decisions(records, rows, reference(summaries, scenario), scenario)}


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
