"""The command ``ms-highway``."""

import argparse
import importlib
import json
import os
import shlex
import sys
import typing
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.progress import Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ms_highway import experiment, report, validation
from ms_highway.bench import bench
from ms_highway.cli_irl import add_irl
from ms_highway.cli_options import add_costs, add_semantics, costs, human_reward
from ms_highway.cli_report import add_report
from ms_highway.cli_sweep import add_sweep
from ms_highway.cli_video import add_video
from ms_highway.compiled import keep_compilations, low_latency
from ms_highway.console import add_command, count_episodes, print_tables
from ms_highway.envs import SCENARIOS, environment_id
from ms_highway.figures import figures
from ms_highway.files import replacing
from ms_highway.planner import Solver
from ms_highway.provenance import add_run, read_runs, this_run

__all__ = ["main"]

COMPARE_HELP = """\
Run the same seeded episodes with several controllers and compare reward and computation.

A controller is a human model that plans every step (naive, turn, tom); or switching:LAMBDA, which chooses the model at
every step and pays LAMBDA reward for a second of planning; or schedule:MODEL=STEPS,...,MODEL, an order that is fixed
beforehand, such as schedule:tom=6,naive. Without scenarios and controllers, the paper's comparison
runs: all three scenarios, each with its ladder and the paper's two lambdas.

Results go to --out: steps.csv (a row per step, written as episodes end), summary.csv, and per scenario the figures
SCENARIO_bars.png, SCENARIO_timeline.png and SCENARIO_curve.png; settings.json and provenance.json say what they were
made with. Stopped and started again with the same --out, it goes on where it was. `ms-highway report` makes a page of
them."""

BENCH_HELP = """\
Measure plans, decisions and environment steps on one core, warm, and compilation, cold and from a cache; for every
scenario and human model. With --peer casadi, the same plans are also written in CasADi, compiled to C, checked to give
the same controls, and measured in the same run (needs the extra "bench" and gcc)."""

COMPARE_EXAMPLES = """\
examples:
  ms-highway compare
  ms-highway compare merger --controllers naive tom switching:0.1 --seeds 10 --out results/merger
  ms-highway compare merger --controllers tom switching:{0.01,0.1} schedule:tom={4,6,8},naive --out results/curve
  ms-highway compare merger --ladder naive tom --controllers switching:0.1 --out results/two_rungs
  ms-highway compare give_way --semantics released --costs measured --out results/measured
  ms-highway compare stay_back --controllers naive turn --solver newton --seeds 100 --out results/newton"""

VALIDATE_HELP = """\
Replay logged episodes of the paper's released code: plan from every logged state and compare controls, rewards, human
controls and switching decisions with the logs. Errors are quantiles over all steps, in the units of the logs."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 if all went well, 2 with one line on standard error if the input was at fault."""
    given = sys.argv[1:] if arguments is None else arguments
    options = _parser().parse_args(given)
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
        print("ms-highway: stopped", file=sys.stderr)
        return 130
    return 0


def _import(modules: Sequence[str]) -> None:
    """Import what a user has added."""
    if modules:
        sys.path.insert(0, os.getcwd())
    for name in modules:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise ImportError(f"--import {name}: {error}") from error


def _keep_compilations() -> None:
    """Keep compiled planners; where that cannot be, say so and go on without."""
    try:
        keep_compilations()
    except OSError as error:
        print(f"ms-highway: compiled planners are not kept: {error}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
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

    command = partial(add_command, commands)
    compare = command("compare", "compare controllers over many episodes", COMPARE_HELP, COMPARE_EXAMPLES)
    compare.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"{', '.join(SCENARIOS)} (default: all)")
    compare.add_argument(
        "--controllers",
        nargs="+",
        metavar="CONTROLLER",
        help="naive, turn, tom, switching:LAMBDA, schedule:MODEL=STEPS,...,MODEL (default: the paper's)",
    )
    compare.add_argument(
        "--seeds", type=int, default=30, help="episodes per controller, seeded 0, 1, ... (default: 30)"
    )
    compare.add_argument(
        "--ladder", nargs="+", metavar="MODEL", help="models to switch among, cheapest first (default: the scenario's)"
    )
    add_semantics(compare)
    compare.add_argument(
        "--solver",
        choices=typing.get_args(Solver),
        default="gradient",
        help="how the robot improves its plans under naive and turn: gradient, the paper's 20 steps (default), or "
        "newton, second-order steps with a line search; tom always takes gradient steps",
    )
    add_costs(compare)
    compare.add_argument(
        "--out", type=Path, default=Path("results/compare"), help="directory of results (default: results/compare)"
    )
    compare.set_defaults(run=_compare)

    add_sweep(commands)
    add_video(commands)
    add_report(commands)

    measure = command(
        "bench",
        "measure planning time",
        BENCH_HELP,
        "examples:\n  ms-highway bench merger\n  ms-highway bench --peer casadi --json bench.json",
    )
    measure.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"{', '.join(SCENARIOS)} (default: all)")
    measure.add_argument("--peer", choices=["casadi"], help="measure the same plans in CasADi's C code as well")
    measure.add_argument("--json", type=Path, metavar="FILE", help="write all figures to a JSON file")
    measure.set_defaults(run=_bench)

    check = command(
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


def _compare(options: argparse.Namespace) -> None:
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; there must be at least one episode")
    scenarios = list(dict.fromkeys(options.scenarios)) or list(SCENARIOS)
    chosen = list(dict.fromkeys(options.controllers or []))
    controllers = {name: chosen or experiment.paper_controllers(name) for name in scenarios}
    chosen_costs = costs(options.costs)
    comparison = experiment.Comparison(
        controllers,
        options.seeds,
        options.semantics,
        chosen_costs,
        options.solver,
        human_reward(options.human_reward),
        options.ladder,
    )
    comparison.check()
    read_runs(options.out)  # refuses what cannot be read before anything is run
    counts, wanted = experiment.run(comparison, options.out), len(list(comparison.episodes()))
    already = next(counts)
    if already < wanted:
        add_run(options.out, this_run(options.command_line))
    count_episodes(counts, already, wanted)
    records = experiment.read(comparison, options.out)
    summaries = report.summary(records)
    with replacing(options.out / "summary.csv") as path:
        summaries.to_csv(path, index=False)
    for scenario in scenarios:
        print_tables(report.table(summaries, scenario))
        for name, figure in figures(records, summaries, scenario).items():
            with replacing(options.out / f"{scenario}_{name}.png") as path:
                figure.savefig(path, dpi=110)
    print(f"results are in {options.out}")


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
        grid.add_column(column, justify="left" if column == "file" else "right")
    for name, errors in result["files"].items():
        cells = [
            " ".join(f"{value:.0e}" for value in errors[kind].values())
            for kind in ("action_error", "reward_error", "human_error")
        ]
        decisions = errors.get("decisions")
        grid.add_row(name, *cells, f"{decisions['agree']} of {decisions['all']}" if decisions else "")
    print_tables(grid)
