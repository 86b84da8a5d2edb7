"""What a page tells of learned rewards: tables and figures of a reward, an evaluation, and examples."""

from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.figure import Figure
from rich.table import Table

from ms_highway.game.learned_reward import LearnedReward
from ms_highway.irl.evaluation import Evaluation
from ms_highway.irl.predictors import check_drivers
from ms_highway.irl.recordings.recording import Recording
from ms_highway.visualization.irl import prediction
from ms_highway.visualization.irl.tables import evaluation_tables, learned_tables


class Section(NamedTuple):
    """Tables, and figures by caption."""

    tables: list[Table]
    figures: dict[str, Figure]


def irl_section(
    evaluation: Evaluation | None = None, learned: LearnedReward | None = None, recordings: Sequence[Recording] = ()
) -> Section:
    """Draw what is given: an evaluation, a learned reward, and both its drivers and recordings for examples.

    Raises:
        ValueError: if examples are to be drawn, and the reward has no drivers or none was recorded for 5 s.
    """
    tables: list[Table] = []
    figures: dict[str, Figure] = {}
    if evaluation:
        tables += evaluation_tables(evaluation)
        figures["errors against the horizon"] = prediction.errors_figure(evaluation)
        figures["log density of recorded positions"] = prediction.likelihood_figure(evaluation)
        figures["calibration of predicted regions"] = prediction.calibration_figure(evaluation)
    if learned:
        tables += learned_tables(learned)
        figures["feature counts"] = prediction.counts_figure(learned)
        if recordings:
            drivers = check_drivers(learned.drivers)
            figures["predicted and recorded paths"] = prediction.paths_figure(recordings, drivers)
    return Section(tables, figures)
