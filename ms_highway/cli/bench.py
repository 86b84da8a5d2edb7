"""The command ``ms-highway bench``."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.bench_road import add_bench_road
from ms_highway.cli.console import add_command, print_tables
from ms_highway.cli.options import MOST, add_devices, add_planning, add_scenarios, planning

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["add_bench"]

HELP = """\
Measure plans, decisions and environment steps on one core, warm, and compilation, cold and from a cache; for every
scenario and human model. With --peer casadi, the same plans are also written in CasADi, compiled to C, checked to give
the same controls, and measured in the same run (needs the extra "bench" and gcc).

With --batches, measure the closed loop instead: how many steps of the robot per second the environments take, on one
core, and the simulation of many episodes at once, by batch size, on --devices; for every model of the ladder and for
switching. MiB is the most memory that the batches have taken until then.

For scenarios with several humans, measure plans by number of humans (--crowd) and horizon (--horizons), a process each;
or, with --responses, compare the humans' block-diagonal response with their full joint one, in random situations among
the last number of --crowd.

`ms-highway bench road` measures how drivers fare in stock scenes of highway-env; it has its own --help."""

EXAMPLES = """\
examples:
  ms-highway bench merger
  ms-highway bench --peer casadi --json bench.json
  ms-highway bench merger --batches 1 16 64 256 1024 8192
  ms-highway bench dense_merge --crowd 1 2 4 6 8 12 --horizons 20
  ms-highway bench dense_merge --crowd 6 --responses 1000
  ms-highway bench road merge --drivers switching idm"""


def add_bench(commands: Any) -> None:
    """Add the command ``bench`` to a parser's subparsers."""
    parser = add_command(commands, "bench", "measure planning time, and the closed loop", HELP, EXAMPLES)
    add_scenarios(parser, "all")
    parser.add_argument("--peer", choices=["casadi"], help="measure the same plans in CasADi's C code as well")
    parser.add_argument(
        "--batches", nargs="+", type=int, metavar="SIZE", help="measure the closed loop in such batches"
    )
    parser.add_argument("--crowd", nargs="+", type=int, metavar="N", help="numbers of humans (default: 1 6 8)")
    parser.add_argument("--horizons", nargs="+", type=int, metavar="K", help="controls in their plans (default: 20)")
    parser.add_argument("--responses", type=int, metavar="COUNT", help="compare responses in so many situations")
    add_devices(parser)
    add_planning(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures to a JSON file")
    parser.set_defaults(run=_bench)
    add_bench_road(parser)


def _bench(options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import Progress, TextColumn, TimeElapsedColumn

    from ms_highway.benchmarks.latency import bench
    from ms_highway.benchmarks.throughput import throughput
    from ms_highway.envs import SCENARIOS, is_crowd, two_player_scenario
    from ms_highway.experiments.comparison import paper_controllers
    from ms_highway.runtime.files import replacing

    if (options.batches and options.peer) or (options.devices and not options.batches):
        raise ValueError("--peer is about plans, and --devices about --batches; leave one out")
    if options.batches and max(options.batches) > MOST:
        raise ValueError(f"--batches has {max(options.batches)}; a batch may have {MOST} episodes")
    scenarios = list(dict.fromkeys(options.scenarios)) or list(SCENARIOS)
    if any(map(is_crowd, scenarios)):
        _bench_crowds(options, scenarios)
        return
    if options.crowd or options.horizons or options.responses:
        raise ValueError("--crowd, --horizons and --responses are about scenarios with several humans; name one")
    for scenario in scenarios:
        two_player_scenario(scenario)  # refuses unknown ones before anything is measured
    columns = TextColumn("{task.description}"), TimeElapsedColumn()
    results: dict[str, dict[str, Any]] = {}
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("measuring", total=None)
        for scenario in scenarios:
            measured = (
                throughput(
                    scenario,
                    paper_controllers(scenario),
                    options.batches,
                    options.devices,
                    options.modules,
                    planning(options),
                )
                if options.batches
                else bench(scenario, peer=options.peer == "casadi", **planning(options))
            )
            for name, result in measured:
                progress.update(task, description=f"measured {scenario}, {name}")
                results.setdefault(scenario, {})[name] = result
    print_tables(*map(_batches, results, results.values()) if options.batches else [_plans(results)])
    if options.json:
        with replacing(options.json) as path:
            path.write_text(json.dumps(results, indent=2) + "\n")


def _bench_crowds(options: argparse.Namespace, scenarios: list[str]) -> None:
    """Measure plans among several humans, or compare their responses."""
    from ms_highway.benchmarks.crowd_latency import crowd_latency
    from ms_highway.benchmarks.joint_response import compare_responses
    from ms_highway.game.crowd_scenario import crowd_scenario
    from ms_highway.runtime.files import replacing

    for scenario in scenarios:
        crowd_scenario(scenario)  # refuses others before anything is measured
    if options.batches or options.peer or planning(options):
        raise ValueError("--batches, --peer and plans' options are for scenarios with one human; leave them out")
    if options.responses is not None and options.responses < 1:
        raise ValueError(f"--responses is {options.responses}; give a number of situations")
    crowd, horizons = options.crowd or [1, 6, 8], options.horizons or [20]
    results: dict[str, Any] = {}
    for scenario in scenarios:
        if options.responses:
            results[scenario] = compare_responses(scenario, crowd[-1], options.responses)
            print_tables(_responses(scenario, crowd[-1], results[scenario]))
            continue
        measured = {f"{number} humans, K = {k}": one for (number, k), one in crowd_latency(scenario, crowd, horizons)}
        results[scenario] = measured
        print_tables(_crowd_plans(scenario, measured))
    if options.json:
        with replacing(options.json) as path:
            path.write_text(json.dumps(results, indent=2) + "\n")


def _crowd_plans(scenario: str, measured: dict[str, Any]) -> "Table":
    """Tabulate what plans among several humans take."""
    from rich.box import SIMPLE
    from rich.table import Table

    grid = Table(box=SIMPLE, title=f"{scenario}: ms of a plan on one core, median (p99)", title_justify="left")
    for column in ("", "all naive", "one tom", "all turn", "all tom", "compile s", "MiB"):
        grid.add_column(column, justify="right" if column else "left")
    for name, result in measured.items():
        times = [result["plan_ms"][kind] for kind in ("naive", "tom_one", "turn", "tom")]
        cells = [f"{median:.2f} ({slow:.2f})" for median, slow in times]
        grid.add_row(name, *cells, f"{result['compile_s']:.1f}", f"{result['memory_mib']:.0f}")
    return grid


def _responses(scenario: str, humans: int, result: dict[str, Any]) -> "Table":
    """Tabulate quantiles of the cosine between ascent directions."""
    from rich.box import SIMPLE
    from rich.table import Table

    title = f"{scenario}: cosine of the ascent with block-diagonal and full response, {humans} humans"
    grid = Table(box=SIMPLE, title=f"{title}; they differ in {result['situations']} of {result['of']}")
    for share in result["cosines"]:
        grid.add_column(f"quantile {share}", justify="right")
    grid.add_row(*(f"{cosine:.4f}" for cosine in result["cosines"].values()))
    return grid


def _plans(results: dict[str, dict[str, Any]]) -> "Table":
    """Tabulate what plans, decisions and steps of the environment take."""
    from rich.box import SIMPLE
    from rich.table import Table

    grid = Table(box=SIMPLE, title="medians, on one core; us: microseconds", title_justify="left")
    names = "plan us", "p99", "C us", "ratio", "decision us", "of mean plan", "step us", "compile s", "cached"
    for column in ("scenario", "model", *names):
        grid.add_column(column, justify="left" if column in ("scenario", "model") else "right")
    for scenario, models in results.items():
        mean_plan = sum(result["plan_us"]["p50"] for result in models.values()) / len(models)
        for model, result in models.items():
            ours, theirs = result["plan_us"], result.get("peer_us", {}).get("p50")
            against = [f"{theirs:.0f}", f"{ours['p50'] / theirs:.2f}"] if theirs else ["", ""]
            decision = [f"{result['decision_us']:.0f}", f"{result['decision_us'] / mean_plan:.0%}"]
            compiling = [f"{result['compile_s'][kind]:.1f}" for kind in ("cold", "cached")]
            rest = [*against, *decision, f"{result['step_us']:.0f}", *compiling]
            grid.add_row(scenario, model, f"{ours['p50']:.0f}", f"{ours['p99']:.0f}", *rest)
    return grid


def _batches(scenario: str, controllers: dict[str, Any]) -> "Table":
    """Tabulate steps per second of a scenario's closed loop, and their ratio to the environment's; a row per size."""
    from rich.box import SIMPLE
    from rich.table import Table

    first = next(iter(controllers.values()))
    title = f"{scenario}: steps of the closed loop per second; batches on {first['devices']}"
    grid = Table(box=SIMPLE, title=title, title_justify="left")
    for column in ("", *controllers, "MiB"):
        grid.add_column(column, justify="right" if column else "left", no_wrap=True)
    grid.add_row("environment", *(f"{result['environment']:,.0f}" for result in controllers.values()), "")
    for size in first["batch"]:
        cells = [
            f"{result['batch'][size]:,.0f} ({result['batch'][size] / result['environment']:.1f}x)"
            for result in controllers.values()
        ]
        memory = max(result["memory_mib"][size] for result in controllers.values())
        grid.add_row(f"batch of {size}", *cells, f"{memory:,.0f}")
    return grid
