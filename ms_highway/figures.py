"""The figures of a comparison: which there are, and what they show."""

import pandas as pd
from matplotlib.figure import Figure

from ms_highway.experiment import paper_controllers
from ms_highway.report import bars, timeline
from ms_highway.story import decisions, one_episode
from ms_highway.tradeoff import SWITCHING, curve, shares

__all__ = ["CAPTIONS", "figures"]

MOST = 8  # controllers beside each other
EPISODES = 2  # whose decisions are drawn

CAPTIONS = {
    "bars": "Reward and time per step of each controller. Whiskers are the 90 % intervals of the mean over episodes; "
    "hatched is the time of deciding about the model.",
    "timeline": "Computation along the episode, as the mean over episodes. Below, which model was in use at every step "
    "of every episode of the controllers that switch.",
    "curve": "Reward against computation: on the left, planning as decisions count it, at T(M); on the right, planning "
    "and deciding as measured. Switching is labelled by lambda; a dashed line joins the best fixed orders of models.",
    "decisions": "Decisions in single episodes. Above, the estimated net gain of switching to each model, before the "
    "step that it is drawn at; one above zero is taken. Below, the reward. The background is the model in use.",
}
"""What the figures of `figures` show."""


def figures(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> dict[str, Figure]:
    """All figures of a scenario, by the names that `CAPTIONS` explains.

    Of more than 8 controllers, bars, timeline and decisions show those that the paper compares, or the first 8.
    """
    controllers = list(summaries.loc[summaries["scenario"] == scenario, "controller"])
    if len(controllers) > MOST:
        paper = paper_controllers(scenario)
        controllers = [name for name in controllers if name in paper] or controllers[:MOST]
    drawn = {
        "bars": bars(summaries[summaries["controller"].isin(controllers)], scenario),
        "timeline": timeline(records[records["controller"].isin(controllers)], scenario),
        "curve": curve(summaries, scenario),
    }
    deciding = [name for name in controllers if name.startswith(SWITCHING)][:EPISODES]
    if not deciding:
        return drawn
    seed = int(records.loc[records["scenario"] == scenario, "seed"].min())
    try:
        dearest = shares(summaries, scenario).attrs["reference"]
        reference = one_episode(records, scenario, dearest, seed)
    except ValueError:  # no fixed model was compared, or not in this episode
        reference = None
    episodes = [one_episode(records, scenario, name, seed) for name in deciding]
    return {**drawn, "decisions": decisions(episodes, reference)}
