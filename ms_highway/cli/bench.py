"""The command ``ms-highway bench``."""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.bench_road import add_bench_road
from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.options import SCENARIO_NAMES, add_devices, add_keys, add_number, configuration

if TYPE_CHECKING:
    from rich.table import Table

HELP = """\
Measure plans, decisions and environment steps on one core, warm, and compilation, cold and from a cache; for every
scenario and human model. With --peer casadi, the same plans are also written in CasADi, compiled to C, checked to give
the same controls, and measured in the same run (needs the extra "bench" and gcc).

With --batches, measure the closed loop instead: how many steps of the robot per second the environments take, on one
core, and the simulation of many episodes at once, by batch size, on --devices; for every model of the ladder and for
switching. MiB is the most memory that the batches have taken until then.

For scenarios with several humans, measure plans by number of humans (--crowd), a process each.

`ms-highway bench road` measures how drivers fare in stock scenes of highway-env; it has its own --help."""

EXAMPLES = """\
examples:
  ms-highway bench merger
  ms-highway bench --peer casadi --json bench.json
  ms-highway bench merger --batches 1 16 64 256 1024 8192
  ms-highway bench dense_merge --crowd 1 2 4 6 8 12
  ms-highway bench road merge --drivers switching idm"""


def add_bench(commands: Any) -> None:
    """Add the command ``bench`` to a parser's subparsers."""
    parser = add_command(commands, "bench", "measure planning time, and the closed loop", HELP, EXAMPLES)
    names = ", ".join(SCENARIO_NAMES)
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"{names} (default: the paper's)")
    parser.add_argument("--peer", choices=["casadi"], help="measure the same plans in CasADi's C code as well")
    add_number(parser, "--batches", None, "measure the closed loop in such batches", nargs="+", metavar="SIZE")
    add_number(parser, "--crowd", None, "numbers of humans (default: 1 6 8)", nargs="+", metavar="N")
    add_devices(parser)
    add_keys(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures to a JSON file")
    parser.set_defaults(run=_bench)
    add_bench_road(parser)


def _bench(options: argparse.Namespace) -> None:
    from ms_highway.benchmarks.latency import bench, bench_several
    from ms_highway.benchmarks.throughput import throughput
    from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, environment_id
    from ms_highway.experiments.comparison import paper_controllers
    from ms_highway.runtime.files import replacing

    if (options.batches and options.peer) or (options.devices and not options.batches):
        raise ValueError("--peer is about plans, and --devices about --batches; leave one out")
    config, results = configuration(options), dict[str, dict[str, Any]]()
    scenarios = list(dict.fromkeys(options.scenarios or PAPER_SCENARIOS))
    for scenario in scenarios:
        environment_id(scenario)  # refuses unknown ones before anything is measured
        if options.peer and SCENARIOS[scenario].streams:
            raise ValueError(f"--peer is for scenarios with one human; leave out {scenario}")
    with telling() as tell:
        for scenario in scenarios:
            if options.batches:
                loops = paper_controllers(scenario), options.batches, options.devices, options.modules
                measured = throughput(scenario, *loops, config)
            elif SCENARIOS[scenario].streams:
                measured = bench_several(scenario, options.crowd or [1, 6, 8], config)
            else:
                measured = bench(scenario, options.peer == "casadi", **config)
            for name, result in measured:
                tell(f"measured {scenario}, {name}")
                results.setdefault(scenario, {})[name] = result
    print_tables(*_tables(results))
    if options.json:
        with replacing(options.json) as path:
            path.write_text(json.dumps(results, indent=2) + "\n")


def _tables(results: Mapping[str, dict[str, Any]]) -> "list[Table]":
    """Tabulate what was measured in each scenario."""
    from ms_highway.visualization.tables import grid

    return [grid(*_rows(scenario, measured)) for scenario, measured in results.items()]


def _rows(scenario: str, measured: Mapping[str, Any]) -> tuple[str, list[dict[str, str]]]:
    """Return the title and the rows of a scenario's table."""
    first = next(iter(measured.values()))
    if "batch" in first:
        title = f"{scenario}: steps of the closed loop per second; batches on {first['devices']}"
        return title, [_loops("environment", None, measured)] + [
            _loops(f"batch of {size}", size, measured) for size in first["batch"]
        ]
    if "plan_ms" in first:
        title = f"{scenario}: ms of a plan on one core, median (p99)"
        return title, [_crowd(name, result) for name, result in measured.items()]
    mean = sum(result["plan_us"]["p50"] for result in measured.values()) / len(measured)
    title = f"{scenario}: medians, on one core; us: microseconds"
    return title, [_plan(name, result, mean) for name, result in measured.items()]


def _plan(model: str, result: dict[str, Any], mean: float) -> dict[str, str]:
    """Return the texts of what a plan, a decision and a step of the environment take."""
    ours, theirs = result["plan_us"], result.get("peer_us", {}).get("p50")
    return {
        "model": model,
        "plan us": f"{ours['p50']:.0f}",
        "p99": f"{ours['p99']:.0f}",
        "C us": f"{theirs:.0f}" if theirs else "",
        "ratio": f"{ours['p50'] / theirs:.2f}" if theirs else "",
        "decision us": f"{result['decision_us']:.0f}",
        "of mean plan": f"{result['decision_us'] / mean:.0%}",
        "step us": f"{result['step_us']:.0f}",
        "compile s": f"{result['compile_s']['cold']:.1f}",
        "cached": f"{result['compile_s']['cached']:.1f}",
    }


def _crowd(name: str, result: dict[str, Any]) -> dict[str, str]:
    """Return the texts of what plans among several humans take."""
    names = {"naive": "all naive", "tom_one": "one tom", "turn": "all turn", "tom": "all tom"}
    times = {names[kind]: "{:.2f} ({:.2f})".format(*result["plan_ms"][kind]) for kind in names}
    return {"": name, **times, "compile s": f"{result['compile_s']:.1f}", "MiB": f"{result['memory_mib']:.0f}"}


def _loops(name: str, size: str | None, measured: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts of steps per second, in the environment or in batches and over the environment's."""
    if size is None:
        return {
            "": name,
            **{controller: f"{result['environment']:,.0f}" for controller, result in measured.items()},
            "MiB": "",
        }
    cells = {
        controller: f"{result['batch'][size]:,.0f} ({result['batch'][size] / result['environment']:.1f}x)"
        for controller, result in measured.items()
    }
    return {"": name, **cells, "MiB": f"{max(result['memory_mib'][size] for result in measured.values()):,.0f}"}
