"""The command ``ms-highway irl record``."""

import argparse
from typing import Any

from ms_highway.cli.console import add_command, count_episodes
from ms_highway.cli.irl.options import DENSITY_NAMES
from ms_highway.cli.options import add_number
from ms_highway.irl.recordings import DRIVERS, TEMPERATURE

HELP = """\
Record episodes of driving on a highway as a Minari data set, in $MINARI_DATASETS_PATH or ~/.minari/datasets.

Every episode is on disk when the next begins; stopped and started again with the same data set and settings, it goes
on where it was. With --driver keyboard the arrow keys drive: up and down for speed, left and right to steer."""

EXAMPLES = """\
examples:
  ms-highway irl record --driver maxent --episodes 200 --dataset ms-highway/maxent-v0
  ms-highway irl record --driver keyboard --episodes 10 --dataset ms-highway/me-v0 --density sparse"""

MOST_SEED = 2**32 - 1  # that JAX's random numbers take


def add_record(commands: Any) -> None:
    """Add the command ``record`` to a parser's subparsers."""
    parser = add_command(commands, "irl record", "record demonstrations", HELP, EXAMPLES)
    drivers = "; ".join(f"{name}: {meaning}" for name, meaning in DRIVERS.items())
    parser.add_argument("--driver", choices=list(DRIVERS), required=True, help=drivers)
    add_number(parser, "--episodes", None, "episodes that the data set is to have", required=True, metavar="N")
    parser.add_argument("--dataset", required=True, metavar="NAME", help="such as ms-highway/maxent-v0")
    parser.add_argument(
        "--density",
        nargs="+",
        choices=DENSITY_NAMES,
        default=list(DENSITY_NAMES),
        help="densities of the traffic, in turn (default: all)",
    )
    parser.add_argument(
        "--temperature",
        type=float,
        default=TEMPERATURE,
        help=f"of the driver maxent, in reward (default: {TEMPERATURE:g})",
    )
    add_number(parser, "--seed", 0, "seed of the first episode", least=0, most=MOST_SEED)
    parser.set_defaults(run=_record)


def _record(options: argparse.Namespace) -> None:
    from ms_highway.irl.recordings.demonstrations import record

    asked = options.driver, options.episodes, options.dataset, options.density, options.seed, options.temperature
    counts = record(*asked)
    already = next(counts)
    done = count_episodes(counts, already, options.episodes)
    print(f"{options.dataset}: {done} episodes of {options.driver}, {done - already} of them new")
