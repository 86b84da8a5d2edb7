"""What a page shows of drivers that were learned from recordings."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from ms_highway.game.learned_reward import SHIPPED, load, shipped
from ms_highway.irl.evaluation import load_evaluation
from ms_highway.irl.moments import cut_moments
from ms_highway.irl.outlook import Modes, expected_path
from ms_highway.irl.predictors import check_drivers, predictions
from ms_highway.irl.recordings.commonroad import read_directory
from ms_highway.irl.regimes import examples
from ms_highway.runtime.progress import Progress, silent
from ms_highway.visualization.irl import prediction
from ms_highway.visualization.irl.tables import evaluation_tables

CAPTIONS = {
    "errors": "Errors of predictions against the horizon.",
    "likelihood": "Mean log density of the recorded positions against the horizon.",
    "calibration": "How often drivers are in the predicted regions.",
    "paths": "Predicted and recorded paths of a few drivers.",
    "counts": "Feature counts of the recordings and of what the learned reward expects.",
}


def drawn(
    evaluation: Path, theta: str, data: str, progress: Progress = silent
) -> tuple[tuple[Table, ...], dict[str, tuple[Figure, str]]]:
    """Tabulate and draw an evaluation of drivers, with the paths of a few of them.

    Args:
        evaluation: file of what ``ms-highway irl evaluate --json`` prints.
        theta: the learned reward, a file of ``ms-highway irl fit``, or ``us101``.
        data: a directory of recordings.
        progress: called with a message before everything that takes time.

    Raises:
        ValueError: if a file cannot be read, or the reward has no drivers.
    """
    found = load_evaluation(evaluation)
    learned = shipped(theta) if theta in SHIPPED else load(Path(theta))
    drivers, moments = check_drivers(learned.drivers), cut_moments(read_directory(Path(data)))
    progress("predicting")
    predicted = predictions(moments, drivers)
    coasting = np.linalg.norm(expected_path(predicted["constant_velocity"].modes) - moments.recorded, axis=-1)
    chosen = examples(moments, coasting)
    some = {
        name: part._replace(modes=Modes(*(np.asarray(values)[list(chosen.values())] for values in part.modes)))
        for name, part in predicted.items()
    }
    figures = {
        "errors": prediction.errors_figure(found),
        "likelihood": prediction.likelihood_figure(found),
        "calibration": prediction.calibration_figure(found),
        "paths": prediction.paths_figure(moments, some, chosen),
        "counts": prediction.counts_figure(learned),
    }
    return evaluation_tables(found), {name: (figure, CAPTIONS[name]) for name, figure in figures.items()}
