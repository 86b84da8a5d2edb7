"""The command ``ms-highway irl evaluate``."""

import argparse
import json
from typing import Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.irl.options import (
    OTHERS,
    REAL_DRIVERS_HELP,
    add_data,
    add_model,
    horizon,
    model,
    read,
    real_drivers,
)

__all__ = ["add_evaluate"]

HELP = """\
Predict recorded drivers for up to 5 s and compare with where they went, beside constant velocity, constant turn rate
and acceleration (CTRA), highway-env's IDM, a fitted IDM and a Kalman filter over lanes. All predict every driver, from
the same moments, once a second.

With --folds instead of --theta, everything is learned from the other recordings, fold after fold. FDE, the distance at
the horizon, and RMSE are in metres; a miss is more than 2 m off; log p is the mean log density of the recorded position
in 1/m^2; "in 90 %" is the share of drivers in the region that holds 90 % of the predicted probability. Windows are
--horizon steps of controls, see irl fit."""

EXAMPLES = """\
examples:
  ms-highway irl evaluate --theta us101 --data recordings --json
  ms-highway irl evaluate --folds 4 --data recordings"""


def add_evaluate(commands: Any) -> None:
    """Add the command ``evaluate`` to a parser's subparsers."""
    parser = add_command(commands, "evaluate", "predict recorded drivers", HELP, EXAMPLES)
    add_data(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--theta", metavar="FILE", help=REAL_DRIVERS_HELP)
    which.add_argument("--folds", type=int, metavar="N", help="cross-validate by recording, in N folds")
    add_model(parser)
    parser.add_argument(
        "--others",
        choices=OTHERS,
        default="predicted",
        help="what predicted drivers meet: the others as they are predicted, all together, so that nothing of the "
        "future is known (default); the others where they were recorded to be, a leak of the future; or the others at "
        "constant velocity",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.set_defaults(run=_evaluate)


def _evaluate(options: argparse.Namespace) -> None:
    from ms_highway.irl.evaluation import cross_validate, evaluate
    from ms_highway.visualization.irl.tables import evaluation_tables

    if options.theta and (options.learn or options.horizon):
        raise ValueError("--learn and --horizon are those of the learned reward --theta; leave them out")
    learned = real_drivers(options.theta) if options.theta else None
    recordings = read(options.data)
    with telling() as tell:
        if learned:
            found = evaluate(recordings, learned, options.others, progress=tell)
        else:
            chosen, steps = model(options, recordings), horizon(options)
            found = cross_validate(recordings, chosen, steps, options.folds, options.others, progress=tell)
    if options.json:
        print(json.dumps(found, indent=2))
        return
    print_tables(*evaluation_tables(found))
