"""The command ``ms-highway irl``: demonstrations, and what can be learnt from them."""

import argparse
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ms_highway import demonstrations
from ms_highway.demonstrators import TEMPERATURE
from ms_highway.routes import DENSITIES

__all__ = ["add_irl"]

IRL_HELP = "Learn what human drivers are after from recordings of how they drive."

RECORD_HELP = """\
Record episodes of driving on a highway as a Minari data set, in $MINARI_DATASETS_PATH or ~/.minari/datasets.

Every episode is on disk when the next begins; stopped and started again with the same data set and settings, it goes
on where it was. With --driver keyboard the arrow keys drive: up and down for speed, left and right to steer."""

RECORD_EXAMPLES = """\
examples:
  ms-highway irl record --driver maxent --episodes 200 --dataset ms-highway/maxent-v0
  ms-highway irl record --driver keyboard --episodes 10 --dataset ms-highway/me-v0 --density sparse"""


def add_irl(commands: Any) -> None:
    """Add the command ``irl`` with its subcommands to a parser's subparsers."""
    irl = commands.add_parser("irl", help="record driving and learn rewards from it", description=IRL_HELP)
    subcommands = irl.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_record(subcommands)


def _add_record(commands: Any) -> None:
    record = commands.add_parser(
        "record",
        help="record demonstrations",
        description=RECORD_HELP,
        epilog=RECORD_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    drivers = "; ".join(f"{name}: {meaning}" for name, meaning in demonstrations.DRIVERS.items())
    record.add_argument("--driver", choices=list(demonstrations.DRIVERS), required=True, help=drivers)
    record.add_argument("--episodes", type=int, required=True, metavar="N", help="episodes the data set shall have")
    record.add_argument("--dataset", required=True, metavar="NAME", help="such as ms-highway/maxent-v0")
    record.add_argument(
        "--density",
        nargs="+",
        choices=list(DENSITIES),
        default=list(DENSITIES),
        help="densities of the traffic, in turn (default: all)",
    )
    record.add_argument(
        "--temperature",
        type=float,
        default=TEMPERATURE,
        help=f"of the driver maxent, in reward (default: {TEMPERATURE:g})",
    )
    record.add_argument("--seed", type=int, default=0, help="seed of the first episode (default: 0)")
    record.set_defaults(run=_record)


def _record(options: argparse.Namespace) -> None:
    counts = demonstrations.record(
        options.driver, options.episodes, options.dataset, options.density, options.seed, options.temperature
    )
    already = done = next(counts)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("episodes", total=max(options.episodes, already), completed=already)
        for done in counts:
            progress.update(task, completed=done)
    print(f"{options.dataset}: {done} episodes of {options.driver}, {done - already} of them new")
