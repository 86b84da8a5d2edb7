"""The command ``ms-highway``."""

import argparse
import importlib
import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.box import SIMPLE
from rich.table import Table

from ms_highway.cli.bench import add_bench
from ms_highway.cli.compare import add_compare
from ms_highway.cli.console import add_command, print_tables, printing
from ms_highway.cli.frontier import add_frontier
from ms_highway.cli.irl import add_irl
from ms_highway.cli.report import add_report
from ms_highway.cli.safety import add_safety
from ms_highway.cli.sweep import add_sweep
from ms_highway.cli.video import add_video
from ms_highway.experiments import validation
from ms_highway.runtime.interrupt import INTERRUPTED, STOPPED
from ms_highway.runtime.jax_settings import keep_compilations, low_latency

__all__ = ["build_parser", "main"]

VALIDATE_HELP = """\
Replay logged episodes of the paper's released code: plan from every logged state and compare controls, rewards, human
controls and switching decisions with the logs. Errors are quantiles over all steps, in the units of the logs."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 if all went well, 2 with one line on standard error if the input was at fault."""
    given = sys.argv[1:] if arguments is None else arguments
    for text in given:
        if any("\ud800" <= letter <= "\udfff" for letter in text):  # how Python keeps other bytes
            print(
                f"ms-highway: {text!r} is not UTF-8, which files of results are written in; rename it", file=sys.stderr
            )
            return 2
    options = build_parser().parse_args(given)
    options.command_line = shlex.join(["ms-highway", *given])
    options.prepare()
    try:
        if not options.no_compilation_cache:
            _keep_compilations()
        _import(options.modules)
        options.run(options)
        with printing():
            sys.stdout.flush()
    except (ValueError, OSError, ImportError) as error:
        print(f"ms-highway: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(STOPPED, file=sys.stderr)
        return INTERRUPTED
    return 0


def _import(modules: Sequence[str]) -> None:
    """Import what a user has added."""
    if modules:
        sys.path.insert(0, os.getcwd())
    for name in modules:
        if name.endswith(".py") or not all(part.isidentifier() for part in name.split(".")):
            raise ImportError(f"--import {name}: give the name of a module, such as brief for brief.py here")
        try:
            importlib.import_module(name)
        except Exception as error:  # a user's module may fail in any way
            raise ImportError(f"--import {name}: {type(error).__name__}: {error}") from error


def _keep_compilations() -> None:
    """Keep compiled planners; where that cannot be, say so and go on without."""
    try:
        keep_compilations()
    except OSError as error:
        print(f"ms-highway: compiled planners are not kept: {error}", file=sys.stderr)


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; what it parses has the command to run in ``run``."""
    parser = argparse.ArgumentParser(
        prog="ms-highway", description="Robot cars that choose how hard to think about human drivers."
    )
    parser.add_argument(
        "--no-compilation-cache",
        action="store_true",
        help="do not keep compiled planners in the user's cache directory, nor use those kept there",
    )
    parser.add_argument(
        "--import",
        dest="modules",
        action="append",
        default=[],
        metavar="MODULE",
        help="a Python module, also of the current directory, to be imported first: one that adds scenarios "
        "(ms_highway.add_scenario), human models (ms_highway.register) or features of rewards (ms_highway.add_feature)",
    )
    parser.set_defaults(prepare=low_latency)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    add_compare(commands)
    add_sweep(commands)
    add_frontier(commands)
    add_safety(commands)
    add_video(commands)
    add_report(commands)

    add_bench(commands)

    check = add_command(
        commands,
        "validate",
        "replay reference episodes",
        VALIDATE_HELP,
        "example:\n  ms-highway validate reference/episodes --json",
    )
    check.add_argument("directory", type=Path, metavar="DIR", help="directory of reference files, SCENARIO__KIND.npz")
    check.add_argument("--json", action="store_true", help="print JSON instead of a table")
    check.set_defaults(run=_validate)

    add_irl(commands)
    return parser


def _validate(options: argparse.Namespace) -> None:
    result = validation.validate(options.directory)
    if options.json:
        print(json.dumps(result, indent=2))
        return
    grid = Table(box=SIMPLE, title="errors against the logs: median, 90 %, 99 %, largest", title_justify="left")
    for column in ("file", "robot's control", "reward", "human's control", "decisions"):
        grid.add_column(column, justify="left" if column == "file" else "right", no_wrap=column == "file")
    for name, errors in result["files"].items():
        cells = [
            " ".join(f"{value:.0e}" for value in errors[kind].values())
            for kind in ("action_error", "reward_error", "human_error")
        ]
        decisions = errors.get("decisions")
        grid.add_row(name, *cells, f"{decisions['agree']} of {decisions['all']}" if decisions else "")
    print_tables(grid)
