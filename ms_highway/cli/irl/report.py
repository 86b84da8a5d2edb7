"""The command ``ms-highway irl report``."""

import argparse
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.irl.options import REAL_DRIVERS_HELP, add_data, check_directory, read, real_drivers, save_figures

__all__ = ["add_report"]

HELP = """\
Draw figures into the directory --out. From --evaluation: errors.png and likelihood.png (errors and log p against the
horizon) and calibration.png (how often drivers are in the predicted regions). From --theta and --data: paths.png
(predicted and recorded paths of a few drivers). From --theta: counts.png (feature counts)."""

EXAMPLES = """\
example:
  ms-highway irl evaluate --theta theta.json --data recordings --json > evaluation.json
  ms-highway irl report --evaluation evaluation.json --theta theta.json --data recordings --out results/report"""


def add_report(commands: Any) -> None:
    """Add the command ``report`` to a parser's subparsers."""
    parser = add_command(commands, "report", "draw what was learned", HELP, EXAMPLES)
    parser.add_argument(
        "--evaluation", type=Path, required=True, metavar="FILE", help="what `ms-highway irl evaluate --json` prints"
    )
    parser.add_argument("--theta", required=True, metavar="FILE", help=REAL_DRIVERS_HELP)
    add_data(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    import numpy as np

    from ms_highway.irl.evaluation import load_evaluation
    from ms_highway.irl.moments import cut_moments
    from ms_highway.irl.outlook import Modes, expected_path
    from ms_highway.irl.predictors import check_drivers, predictions
    from ms_highway.irl.regimes import examples
    from ms_highway.visualization.irl.prediction import (
        calibration_figure,
        counts_figure,
        errors_figure,
        likelihood_figure,
        paths_figure,
    )
    from ms_highway.visualization.irl.tables import evaluation_tables

    check_directory(options.out)
    evaluation = load_evaluation(options.evaluation)
    learned = real_drivers(options.theta)
    drivers, recordings = check_drivers(learned.drivers), read(options.data)
    with telling() as tell:
        tell("predicting")
        moments = cut_moments(recordings)
        found = predictions(moments, drivers)
        coasting = np.linalg.norm(expected_path(found["constant_velocity"].modes) - moments.recorded, axis=-1)
        chosen = examples(moments, coasting)
    some = {
        name: part._replace(modes=Modes(*(np.asarray(values)[list(chosen.values())] for values in part.modes)))
        for name, part in found.items()
    }
    figures = {
        "errors": errors_figure(evaluation),
        "likelihood": likelihood_figure(evaluation),
        "calibration": calibration_figure(evaluation),
        "paths": paths_figure(moments, some, chosen),
        "counts": counts_figure(learned),
    }
    save_figures(figures, options.out)
    print_tables(*evaluation_tables(evaluation))
    print(f"figures are in {options.out}")
