"""What a page shows of drivers that were learned from recordings."""

from pathlib import Path

from matplotlib.figure import Figure
from rich.table import Table

from ms_highway.game.learned_reward import named
from ms_highway.irl.evaluation import load_evaluation
from ms_highway.irl.predictors import check_drivers
from ms_highway.irl.recordings.commonroad import read_directory
from ms_highway.runtime.progress import Progress, silent
from ms_highway.visualization.irl import prediction
from ms_highway.visualization.irl.tables import evaluation_tables


def drawn(
    evaluation: Path, theta: str, data: str, progress: Progress = silent
) -> tuple[list[Table], dict[str, tuple[Figure, str]]]:
    """Tabulate and draw an evaluation of drivers, with the paths of a few of them; return figures with captions.

    Args:
        evaluation: file of what ``ms-highway irl evaluate --json`` prints.
        theta: the learned reward, a file of ``ms-highway irl fit``, or ``us101``.
        data: a directory of recordings.
        progress: called with a message before everything that takes time.

    Raises:
        ValueError: if a file cannot be read, the reward has no drivers, or nobody was recorded for 5 s.
    """
    found, learned = load_evaluation(evaluation), named(theta)
    drivers = check_drivers(learned.drivers, theta)
    recordings = read_directory(Path(data))
    progress("predicting")
    return evaluation_tables(found), {
        "errors": (prediction.errors_figure(found), "Errors of predictions against the horizon."),
        "likelihood": (prediction.likelihood_figure(found), "Mean log density of recorded positions."),
        "calibration": (prediction.calibration_figure(found), "How often drivers are in the predicted regions."),
        "paths": (prediction.paths_figure(recordings, drivers), "Predicted and recorded paths of a few drivers."),
        "counts": (prediction.counts_figure(learned), "Feature counts: recorded, and expected under the reward."),
    }
