"""The command ``ms-highway irl report``."""

import argparse
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.irl.options import THETA_HELP, add_data, check_directory, read, save_figures, theta

__all__ = ["add_report"]

HELP = """\
Draw what was learned: errors.png (error against horizon, of the evaluation), paths.png (predicted and recorded paths of
a few drivers of the recordings) and counts.png (feature counts, of the learned reward), in the directory --out."""

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
    parser.add_argument("--theta", required=True, metavar="FILE", help=THETA_HELP)
    add_data(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    import numpy as np

    from ms_highway.irl.evaluation import load_evaluation
    from ms_highway.irl.prediction import cut_cases, predictions
    from ms_highway.irl.regimes import examples
    from ms_highway.visualization.irl.prediction import counts_figure, errors_figure, paths_figure
    from ms_highway.visualization.irl.tables import evaluation_table, regimes_table

    check_directory(options.out)
    evaluation = load_evaluation(options.evaluation)
    learned, recordings = theta(options.theta), read(options.data)
    with telling() as tell:
        tell("choosing examples")
        cases = cut_cases(recordings)
        chosen = examples(cases)
        cases = cases.of(np.array(list(chosen.values())))
        tell(f"driving {len(cases)} examples")
        paths = predictions(cases, learned.sharp_weights, learned.horizon)
    figures = {
        "errors": errors_figure(evaluation),
        "paths": paths_figure(cases, paths, list(chosen)),
        "counts": counts_figure(learned),
    }
    save_figures(figures, options.out)
    print_tables(evaluation_table(evaluation), regimes_table(evaluation))
    print(f"figures are in {options.out}")
