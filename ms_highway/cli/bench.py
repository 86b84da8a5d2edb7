"""The command ``ms-highway bench``."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.options import add_devices, add_keys, add_number, add_scenarios, configuration

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

`ms-highway bench road` measures how drivers fare in stock scenes of highway-env."""

EXAMPLES = """\
examples:
  ms-highway bench merger
  ms-highway bench --peer casadi --json bench.json
  ms-highway bench merger --batches 1 16 64 256 1024 8192
  ms-highway bench dense_merge --crowd 1 2 4 6 8 12
  ms-highway bench road merge --drivers switching idm"""


PEER = {"C us": "{peer_us[p50]:.0f}", "ratio": "{ratio:.2f}"}
PLANS = {
    "plan us": "{plan_us[p50]:.0f}",
    "p99": "{plan_us[p99]:.0f}",
    "decision us": "{decision_us:.0f}",
    "of mean plan": "{of_mean_plan:.0%}",
    "step us": "{step_us:.0f}",
    "compile s": "{compile_s[cold]:.1f}",
    "cached": "{compile_s[cached]:.1f}",
}
SEVERAL = {
    "all naive": "{plan_ms[naive][0]:.2f} ({plan_ms[naive][1]:.2f})",
    "one tom": "{plan_ms[tom_one][0]:.2f} ({plan_ms[tom_one][1]:.2f})",
    "all turn": "{plan_ms[turn][0]:.2f} ({plan_ms[turn][1]:.2f})",
    "all tom": "{plan_ms[tom][0]:.2f} ({plan_ms[tom][1]:.2f})",
    "compile s": "{compile_s:.1f}",
    "MiB": "{memory_mib:.0f}",
}
"""Headings of tables, and how their texts are made of what was measured."""


def add_bench(commands: Any) -> None:
    """Add the command ``bench`` to a parser's subparsers."""
    parser = add_command(commands, "bench", "measure planning time, and the closed loop", HELP, EXAMPLES)
    add_scenarios(parser)
    parser.add_argument("--peer", choices=["casadi"], help="measure the same plans in CasADi's C code as well")
    add_number(parser, "--batches", None, "measure the closed loop in such batches", nargs="+", metavar="SIZE")
    add_number(parser, "--crowd", None, "numbers of humans (default: 1 6 8)", nargs="+", metavar="N")
    add_devices(parser)
    add_keys(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures to a JSON file")
    parser.set_defaults(run=_bench)


def _bench(options: argparse.Namespace) -> None:
    from ms_highway.benchmarks.latency import bench, bench_several
    from ms_highway.benchmarks.throughput import throughput
    from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, environment_id
    from ms_highway.experiments.comparison import paper_controllers
    from ms_highway.runtime.files import write_json

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
    print_tables(*map(_table, results, results.values()))
    if options.json:
        write_json(options.json, results)


def _table(scenario: str, measured: Mapping[str, Any]) -> "Table":
    """Tabulate what was measured in a scenario."""
    from ms_highway.visualization.tables import grid

    results = list(measured.values())
    if "batch" in results[0]:
        devices = results[0]["devices"]
        rows = [
            {"": "environment", **{name: f"{one['environment']:,.0f}" for name, one in measured.items()}, "MiB": ""}
        ]
        for size in results[0]["batch"]:
            row = {"": f"batch of {size}"}
            for name, one in measured.items():
                row[name] = f"{one['batch'][size]:,.0f} ({one['batch'][size] / one['environment']:.1f}x)"
            rows.append({**row, "MiB": f"{max(one['memory_mib'][size] for one in results):,.0f}"})
        return grid(f"{scenario}: steps of the closed loop per second; batches on {devices}", rows)
    forms, what = SEVERAL, "ms of a plan on one core, median (p99)"
    if "plan_us" in results[0]:
        forms, what = (PEER if "peer_us" in results[0] else {}) | PLANS, "medians, on one core; us: microseconds"
        mean = sum(one["plan_us"]["p50"] for one in results) / len(results)
        for one in results:
            if "peer_us" in one:
                one["ratio"] = one["plan_us"]["p50"] / one["peer_us"]["p50"]
            one["of_mean_plan"] = one["decision_us"] / mean
    rows = [{"": name, **{key: form.format(**one) for key, form in forms.items()}} for name, one in measured.items()]
    return grid(f"{scenario}: {what}", rows)
