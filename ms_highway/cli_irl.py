"""The command ``ms-highway irl``: demonstrations, and what can be learnt from them."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ms_highway import commonroad, demonstrations, irl_report
from ms_highway.demonstrators import TEMPERATURE
from ms_highway.files import replacing
from ms_highway.learning import SIMULATED
from ms_highway.learnt import SHIPPED, load, shipped
from ms_highway.prediction import cases_of, constant_velocity, drive, idm
from ms_highway.recovery import recover
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


RECOVER_HELP = """\
Learn the weights of simulated drivers from more and more of their demonstrations, and compare them with the true ones
and by what they are worth on the last --held-out demonstrations, which are never learnt from.

Results go to --out: recovery.csv (a row per driver, number of demonstrations and weight), weights.png and
likelihood.png."""

RECOVER_EXAMPLES = """\
examples:
  ms-highway irl recover --data minari:ms-highway/maxent-v0 --out results/recovery
  ms-highway irl recover --data minari:ms-highway/maxent-v0 minari:ms-highway/mpc-v0 --demonstrations 16 64 --out out"""

REPORT_HELP = """\
Draw what was learnt: errors.png (error against horizon, of the evaluation), paths.png (predicted and recorded paths of
a few drivers of the recordings) and counts.png (feature counts, of the learnt reward), in the directory --out."""

REPORT_EXAMPLES = """\
example:
  ms-highway irl evaluate --theta theta.json --data recordings --json > evaluation.json
  ms-highway irl report --evaluation evaluation.json --theta theta.json --data recordings --out results/report"""

DPI = 110


def add_irl(commands: Any) -> None:
    """Add the command ``irl`` with its subcommands to a parser's subparsers."""
    irl = commands.add_parser("irl", help="record driving and learn rewards from it", description=IRL_HELP)
    subcommands = irl.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _add_record(subcommands)
    _add_recover(subcommands)
    _add_report(subcommands)


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


def _add_recover(commands: Any) -> None:
    parser = commands.add_parser(
        "recover",
        help="recover known weights",
        description=RECOVER_HELP,
        epilog=RECOVER_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--data", nargs="+", required=True, metavar="minari:NAME", help="data sets of `ms-highway irl record`"
    )
    parser.add_argument(
        "--demonstrations",
        nargs="+",
        type=int,
        default=[4, 16, 64, 256],
        metavar="N",
        help="numbers of demonstrations to learn from (default: 4 16 64 256)",
    )
    parser.add_argument(
        "--held-out", type=int, default=64, metavar="N", help="demonstrations to judge by, the last (default: 64)"
    )
    parser.add_argument("--horizon", type=int, default=5, help="length of windows and plans, in steps (default: 5)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_recover)


def _recover(options: argparse.Namespace) -> None:
    if options.horizon < 1:
        raise ValueError(f"--horizon is {options.horizon}; a window has at least one step")
    data = list(dict.fromkeys(options.data))
    for name in data:
        if not name.startswith("minari:"):
            raise ValueError(f"--data is {name!r}; true weights are known of simulated drivers only, minari:NAME")
    sets = {name.removeprefix("minari:"): demonstrations.load(name.removeprefix("minari:")) for name in data}
    tables = []
    with _spinner() as progress:
        task = progress.add_task("", total=None)
        for name, recordings in sets.items():
            for found in recover(recordings, options.demonstrations, SIMULATED, options.horizon, options.held_out):
                if isinstance(found, str):
                    progress.update(task, description=f"{name}: {found}")
                else:
                    found.insert(0, "driver", name)
                    tables.append(found)
    rows = pd.concat(tables, ignore_index=True)
    with replacing(options.out / "recovery.csv") as path:
        rows.to_csv(path, index=False)
    figures = {"weights": irl_report.weights_figure(rows), "likelihood": irl_report.likelihood_figure(rows)}
    _save_figures(figures, options.out)
    Console(width=max(Console().width, 120)).print(irl_report.recovery_table(rows))
    print(f"results are in {options.out}")


def _add_report(commands: Any) -> None:
    parser = commands.add_parser(
        "report",
        help="draw what was learnt",
        description=REPORT_HELP,
        epilog=REPORT_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--evaluation", type=Path, required=True, metavar="FILE", help="what `ms-highway irl evaluate --json` prints"
    )
    parser.add_argument(
        "--theta", required=True, metavar="FILE", help=f"a learnt reward: a file, or one of {', '.join(SHIPPED)}"
    )
    parser.add_argument(
        "--data",
        required=True,
        metavar="DIR|minari:NAME",
        help="where examples are from: CommonRoad scenarios, or a Minari data set",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> None:
    evaluation = irl_report.load_evaluation(options.evaluation)
    learnt = shipped(options.theta) if options.theta in SHIPPED else load(Path(options.theta))
    with _spinner() as progress:
        task = progress.add_task("reading", total=None)
        if options.data.startswith("minari:"):
            recordings = demonstrations.load(options.data.removeprefix("minari:"))
        else:
            recordings = commonroad.read_directory(Path(options.data))
        progress.update(task, description="choosing examples")
        cases = cases_of(recordings)
        chosen = irl_report.examples(cases)
        cases = cases.of(np.array(list(chosen.values())))
        progress.update(task, description=f"driving {len(cases)} examples")
        paths = {
            "model": drive(cases, learnt.sharp_weights, learnt.horizon),
            "constant_velocity": constant_velocity(cases),
            "idm": idm(cases),
        }
    figures = {
        "errors": irl_report.errors_figure(evaluation),
        "paths": irl_report.paths_figure(cases, paths, list(chosen)),
        "counts": irl_report.counts_figure(learnt),
    }
    _save_figures(figures, options.out)
    Console(width=max(Console().width, 120)).print(irl_report.evaluation_table(evaluation))
    print(f"figures are in {options.out}")


def _spinner() -> Progress:
    """What is being done, and for how long."""
    return Progress(TextColumn("{task.description}"), TimeElapsedColumn(), console=Console(stderr=True), transient=True)


def _save_figures(figures: dict[str, Figure], directory: Path) -> None:
    for name, figure in figures.items():
        with replacing(directory / f"{name}.png") as path:
            figure.savefig(path, dpi=DPI)
