"""The figures of a comparison: which there are, what they show, and the formats of their files."""

import io
from collections.abc import Callable
from functools import partial

import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from ms_highway.experiments.records import common_seeds, one_episode
from ms_highway.experiments.summary import choosing_controllers, most_informative_pair
from ms_highway.visualization.comparison import bars, timeline
from ms_highway.visualization.decisions import decisions
from ms_highway.visualization.tradeoff import curve

FEWEST_LAMBDAS = 3  # that make a curve
MOST_CONTROLLERS = 8  # in bars and timelines, the first ones
MOST_DECIDING = 2  # controllers whose decisions are drawn beside each other
DPI = 160

CAPTIONS = {
    "bars": "Reward and time per step of each controller. Whiskers are the 90 % intervals of the mean over episodes; "
    "hatched is the time of deciding about the model.",
    "timeline": "Computation along the episode, as the mean over episodes. Below, which model was in use at every step "
    "of every episode of the controllers that choose it online.",
    "curve": "Reward against computation: on the left, planning as decisions count it, at T(M); on the right, planning "
    "and deciding as measured. Whiskers are the 90 % intervals. Controllers that choose online are labelled by lambda. "
    "Where schedules were compared, a dashed line is the most that anything fixed earns with so much computation or "
    "less, in these episodes. "
    "Crosses draw their models at random.",
    "decisions": "Decisions in single episodes. Above, the estimated net gain of switching to each model, before the "
    "step that it is drawn at; one above zero is taken. For learned values, it is what all that follows is worth more "
    "than with the model in use. Below, the reward. The background is the model in use.",
}
"""What the figures of `figures` show."""


def figures(records: pd.DataFrame, summaries: pd.DataFrame, scenario: str) -> dict[str, Callable[[], Figure]]:
    """Return functions that draw the figures of a scenario, by the names that `CAPTIONS` explains.

    Reward and computation are a curve of all controllers where a kind has three lambdas, and else bars. Decisions are
    those of two controllers that choose online, beside the best fixed model, from the first start that all of them have
    driven.

    Args:
        records: a row per step, see `ms_highway.experiments.records.columns`.
        summaries: of `ms_highway.experiments.summary.summary`.
        scenario: its name.
    """
    rows = summaries.query("scenario == @scenario")
    main = rows["controller"][:MOST_CONTROLLERS]
    if rows.groupby("kind")["price"].nunique().max() >= FEWEST_LAMBDAS:
        found: dict[str, Callable[[], Figure]] = {"curve": partial(curve, summaries, scenario)}
    else:
        found = {"bars": partial(bars, rows[rows["controller"].isin(main)], scenario)}
    found["timeline"] = partial(timeline, records[records["controller"].isin(main)], scenario)
    deciding = choosing_controllers(summaries, scenario)[:MOST_DECIDING]
    beside = [name for name in most_informative_pair(summaries, scenario) if name not in deciding][:1]
    seeds = common_seeds(records, scenario, [*deciding, *beside])
    if deciding and seeds:
        episodes = [one_episode(records, scenario, name, seeds[0]) for name in (*deciding, *beside)]
        found["decisions"] = partial(decisions, episodes[: len(deciding)], *episodes[len(deciding) :])
    return found


def content(figure: Figure, kind: str = "png") -> bytes:
    """Return the content of a file of a figure: ``png``, ``pdf`` with fonts that publishers take, or ``svg``."""
    written = io.BytesIO()
    with rc_context({"pdf.fonttype": 42}):  # TrueType
        figure.savefig(written, format=kind, dpi=DPI)
    return written.getvalue()
