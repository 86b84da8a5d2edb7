"""The command ``ms-highway irl recover``."""

import argparse
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.irl.options import MINARI, add_horizon, check_directory, horizon, save_figures
from ms_highway.runtime.files import replacing

__all__ = ["add_recover"]

HELP = """\
Learn the weights of simulated drivers from more and more of their demonstrations, and compare them with the true ones
and by what they are worth on the last --held-out demonstrations, which are never learned from.

Results go to --out: recovery.csv (a row per driver, number of demonstrations and weight), weights.png and
likelihood.png."""

EXAMPLES = """\
examples:
  ms-highway irl recover --data minari:ms-highway/maxent-v0 --out results/recovery
  ms-highway irl recover --data minari:ms-highway/maxent-v0 minari:ms-highway/mpc-v0 --demonstrations 16 64 --out out"""


def add_recover(commands: Any) -> None:
    """Add the command ``recover`` to a parser's subparsers."""
    parser = add_command(commands, "recover", "recover known weights", HELP, EXAMPLES)
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
    add_horizon(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of results")
    parser.set_defaults(run=_recover)


def _recover(options: argparse.Namespace) -> None:
    import pandas as pd

    from ms_highway.irl.learning import SIMULATED
    from ms_highway.irl.recordings.datasets import known_weights, load
    from ms_highway.irl.recovery import recover
    from ms_highway.visualization.irl.recovery import likelihood_figure, weights_figure
    from ms_highway.visualization.irl.tables import recovery_table

    check_directory(options.out)
    steps = horizon(options)
    data = list(dict.fromkeys(options.data))
    for name in data:
        if not name.startswith(MINARI):
            raise ValueError(f"--data is {name!r}; true weights are known of simulated drivers only, minari:NAME")
    names = [name.removeprefix(MINARI) for name in data]
    for name in names:
        if known_weights(name) is None:
            raise ValueError(f"the true weights of {name} are unknown: a person recorded it; choose another data set")
    sets = {name: load(name) for name in names}
    tables = []
    for name, recordings in sets.items():
        with telling() as tell:
            found = recover(recordings, options.demonstrations, SIMULATED, steps, options.held_out, progress=tell)
        found.insert(0, "driver", name)
        tables.append(found)
    rows = pd.concat(tables, ignore_index=True)
    figures = {"weights": weights_figure(rows), "likelihood": likelihood_figure(rows)}
    with replacing(options.out / "recovery.csv") as path:
        rows.to_csv(path, index=False)
    save_figures(figures, options.out)
    print_tables(recovery_table(rows))
    print(f"results are in {options.out}")
