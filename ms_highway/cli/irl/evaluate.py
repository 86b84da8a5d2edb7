"""The command ``ms-highway irl evaluate``."""

import argparse
from typing import Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.irl.options import OTHERS, add_data, model, read

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
    parser = add_command(commands, "irl evaluate", "predict recorded drivers", HELP, EXAMPLES)
    add_data(parser)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--theta",
        metavar="FILE",
        help="a reward learned from real recordings: a file of `ms-highway irl fit`, or us101",
    )
    which.add_argument("--folds", type=int, metavar="N", help="cross-validate by recording, in N folds")
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
    import msgspec

    from ms_highway.game.learned_reward import named
    from ms_highway.irl.evaluation import cross_validate, evaluate_reward
    from ms_highway.irl.predictors import check_drivers
    from ms_highway.visualization.irl.tables import evaluation_tables

    if options.theta:
        if options.learn or options.horizon:
            raise ValueError("--learn and --horizon are those of the learned reward --theta; leave them out")
        learned = named(options.theta)
        check_drivers(learned.drivers, f"--theta {options.theta}")
    recordings = read(options.data)
    with telling() as tell:
        if options.theta:
            found = evaluate_reward(recordings, learned, options.others, progress=tell)
        else:
            chosen = model(options, recordings)
            found = cross_validate(recordings, *chosen, options.folds, options.others, progress=tell)
    if options.json:
        print(msgspec.json.format(msgspec.json.encode(found), indent=2).decode())
    else:
        print_tables(*evaluation_tables(found))
