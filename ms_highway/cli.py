"""The command ``ms-highway``."""

import argparse
import importlib
import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ms_highway import validation
from ms_highway.bench import bench
from ms_highway.cli_compare import add_compare
from ms_highway.cli_frontier import add_frontier
from ms_highway.cli_irl import add_irl
from ms_highway.cli_report import add_report
from ms_highway.cli_sweep import add_sweep
from ms_highway.cli_video import add_video
from ms_highway.compiled import keep_compilations, low_latency
from ms_highway.console import add_command, print_tables
from ms_highway.envs import SCENARIOS, environment_id
from ms_highway.files import replacing

__all__ = ["build_parser", "main"]

BENCH_HELP = """\
Measure plans, decisions and environment steps on one core, warm, and compilation, cold and from a cache; for every
scenario and human model. With --peer casadi, the same plans are also written in CasADi, compiled to C, checked to give
the same controls, and measured in the same run (needs the extra "bench" and gcc)."""

VALIDATE_HELP = """\
Replay logged episodes of the paper's released code: plan from every logged state and compare controls, rewards, human
controls and switching decisions with the logs. Errors are quantiles over all steps, in the units of the logs."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 if all went well, 2 with one line on standard error if the input was at fault."""
    given = sys.argv[1:] if arguments is None else arguments
    options = build_parser().parse_args(given)
    options.command_line = shlex.join(["ms-highway", *given])
    if not getattr(options, "in_batches", False):
        low_latency()
    try:
        if not options.no_compilation_cache:
            _keep_compilations()
        _import(options.modules)
        options.run(options)
    except (ValueError, OSError, ImportError) as error:
        print(f"ms-highway: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("ms-highway: stopped; compare goes on when it is started again in the same way", file=sys.stderr)
        return 130
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
        "(ms_highway.envs.add_scenario) or human models (ms_highway.human_models.register)",
    )
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    add_compare(commands)
    add_sweep(commands)
    add_frontier(commands)
    add_video(commands)
    add_report(commands)

    measure = add_command(
        commands,
        "bench",
        "measure planning time",
        BENCH_HELP,
        "examples:\n  ms-highway bench merger\n  ms-highway bench --peer casadi --json bench.json",
    )
    measure.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"{', '.join(SCENARIOS)} (default: all)")
    measure.add_argument("--peer", choices=["casadi"], help="measure the same plans in CasADi's C code as well")
    measure.add_argument("--json", type=Path, metavar="FILE", help="write all figures to a JSON file")
    measure.set_defaults(run=_bench)

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


def _bench(options: argparse.Namespace) -> None:
    scenarios = list(dict.fromkeys(options.scenarios)) or list(SCENARIOS)
    for scenario in scenarios:
        environment_id(scenario)  # refuses unknown ones before anything is measured
    results: dict[str, dict[str, Any]] = {}
    grid = Table(box=SIMPLE, title="medians, on one core; us: microseconds", title_justify="left")
    names = "plan us", "p99", "C us", "ratio", "decision us", "of mean plan", "step us", "compile s", "cached"
    for column in ("scenario", "model", *names):
        grid.add_column(column, justify="left" if column in ("scenario", "model") else "right")
    with Progress(TextColumn("{task.description}"), TimeElapsedColumn(), console=Console(stderr=True)) as progress:
        task = progress.add_task("measuring", total=None)
        for scenario in scenarios:
            results[scenario] = {}
            for model, result in bench(scenario, peer=options.peer == "casadi"):
                progress.update(task, description=f"measured {scenario}, {model}")
                results[scenario][model] = result
            mean_plan = sum(result["plan_us"]["p50"] for result in results[scenario].values()) / len(results[scenario])
            for model, result in results[scenario].items():
                ours, theirs = result["plan_us"], result.get("peer_us", {}).get("p50")
                against = [f"{theirs:.0f}", f"{ours['p50'] / theirs:.2f}"] if theirs else ["", ""]
                decision = [f"{result['decision_us']:.0f}", f"{result['decision_us'] / mean_plan:.0%}"]
                compiling = [f"{result['compile_s'][kind]:.1f}" for kind in ("cold", "cached")]
                rest = [*against, *decision, f"{result['step_us']:.0f}", *compiling]
                grid.add_row(scenario, model, f"{ours['p50']:.0f}", f"{ours['p99']:.0f}", *rest)
    print_tables(grid)
    if options.json:
        with replacing(options.json) as path:
            path.write_text(json.dumps(results, indent=2) + "\n")


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
