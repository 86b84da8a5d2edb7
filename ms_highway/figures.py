"""The figures of a comparison: which there are, and what they show."""

import pandas as pd
from matplotlib.figure import Figure

from ms_highway.report import bars, timeline
from ms_highway.tradeoff import curve

__all__ = ["CAPTIONS", "figures"]

CAPTIONS = {
    "bars": "Reward and time per step of each controller. Whiskers are the 90 % intervals of the mean over episodes; "
    "hatched is the time of deciding about the model.",
    "timeline": "Computation along the episode, as the mean over episodes. Below, which model was in use at every step "
    "of every episode of the controllers that switch.",
    "curve": "Reward against computation: on the left, planning as decisions count it, at T(M); on the right, planning "
    "and deciding as measured. Switching is labelled by lambda; a dashed line joins the best fixed orders of models.",
}
"""What the figures of `figures` show."""


def figures(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> dict[str, Figure]:
    """All figures of a scenario, by the names that `CAPTIONS` explains."""
    return {
        "bars": bars(summaries, scenario),
        "timeline": timeline(records, scenario),
        "curve": curve(summaries, scenario),
    }
