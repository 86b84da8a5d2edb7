"""The figures of a comparison: which there are, and what they show."""

import pandas as pd
from matplotlib.figure import Figure

from ms_highway.report import bars, timeline

__all__ = ["CAPTIONS", "figures"]

CAPTIONS = {
    "bars": "Reward and time per step of each controller. Whiskers are the 90 % intervals of the mean over episodes; "
    "hatched is the time of deciding about the model.",
    "timeline": "Computation along the episode, as the mean over episodes. Below, which model was in use at every step "
    "of every episode of the controllers that switch.",
}
"""What the figures of `figures` show."""


def figures(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> dict[str, Figure]:
    """All figures of a scenario, by the names that `CAPTIONS` explains."""
    return {"bars": bars(summaries, scenario), "timeline": timeline(records, scenario)}
