"""The command ``ms-highway bench``."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ms_highway.cli.command import command, number, option, output
from ms_highway.cli.console import print_tables, telling
from ms_highway.cli.options import DEVICES, MOST_SEEDS, SCENARIOS, SET, configuration, controllers

if TYPE_CHECKING:
    from rich.table import Table

LATENCY = {
    "plan us": "{plan_us[p50]:.0f}",
    "p99": "{plan_us[p99]:.0f}",
    "decision us": "{decision_us:.0f}",
    "of mean plan": "{of_mean_plan:.0%}",
    "step us": "{step_us:.0f}",
    "compile s": "{compile_s[cold]:.1f}",
    "cached": "{compile_s[cached]:.1f}",
}
CROWD = {
    "all naive": "{plan_ms[naive][0]:.2f} ({plan_ms[naive][1]:.2f})",
    "one tom": "{plan_ms[tom_one][0]:.2f} ({plan_ms[tom_one][1]:.2f})",
    "all turn": "{plan_ms[turn][0]:.2f} ({plan_ms[turn][1]:.2f})",
    "all tom": "{plan_ms[tom][0]:.2f} ({plan_ms[tom][1]:.2f})",
    "compile s": "{compile_s:.1f}",
    "MiB": "{memory_mib:.0f}",
}
STEADY = {
    "growth": "{growth:.2f}",
    "reward /step": "{reward[mean]:+.3f} ({reward[low]:+.3f}, {reward[high]:+.3f})",
    "|reward|": "{reward[absolute]:.2g}",
    "collisions": "{collisions[0]} -> {collisions[1]}",
    "success changed": "{success_changes:.0%}",
}
"""Headings of tables, and how their texts are made of what was measured."""

NOISES = 1e-5, 10.0  # m, what single precision still tells apart, and the most
STARTS = 24


@command(
    "bench",
    "measure planning time, the closed loop, and steadiness",
    SCENARIOS,
    number("--batches", None, "measure the closed loop in such batches", nargs="+", metavar="SIZE"),
    number("--crowd", None, "numbers of humans (default: 1 6 8)", nargs="+", metavar="N"),
    number("--noise", None, "measure steadiness under such noise", *NOISES, nargs="+", metavar="NOISE"),
    option("--seen", "put the --noise into what the robot sees in every step", action="store_true"),
    number("--seeds", None, f"starts to add --noise to (default: {STARTS})", 2),
    number("--seed", None, "of the first start (default: 0)", 0, MOST_SEEDS),
    controllers("Those of --noise (default: all models of the ladder)"),
    DEVICES,
    SET,
    output("--json", "write all figures to a JSON file"),
)
def bench(options: argparse.Namespace) -> None:
    """Measure plans, decisions and environment steps on one core, warm, and compilation, cold and from a cache; for
    every scenario and human model.

    With --batches, measure the closed loop instead: how many steps of the robot per second the environments take, on
    one core, and the simulation of many episodes at once, by batch size, on --devices; for every model of the ladder
    and for switching. MiB is the most memory that the batches have taken until then.

    For scenarios with several humans, measure plans by number of humans (--crowd), a process each.

    With --noise, measure how steady driving is: drive --seeds starts as they were drawn, and again with normal noise
    added to the start of the robot and of every human or, with --seen, to what the robot sees of them and of itself in
    every step. NOISE is its standard deviation, of x and y [m] and of the speed [m/s]; that of the heading is NOISE /
    20 rad, so that the velocity changes as much across the road. Cars that nobody drives keep their starts, and are
    seen as they are. The table tells how far apart the robot is with noise and without after so many steps, the median
    and the 95 % quantile over the starts; growth, the factor per step of the median, from a straight line through its
    logarithm over 20 steps (noise is forgotten below 1, not even corrected at 1.05, amplified above); the change of the
    reward per step with its 90 % interval, and the mean of its magnitude; the share of the episodes whose success
    changes, among several humans; and episodes with a collision without noise and with it. Numbers have single
    precision: a distance below 0.01 mm is rounding.

    `ms-highway bench road` measures how drivers fare in stock scenes of highway-env.

    Examples:
      ms-highway bench merger
      ms-highway bench --json bench.json
      ms-highway bench merger --batches 1 16 64 256 1024 8192
      ms-highway bench dense_merge --crowd 1 2 4 6 8 12
      ms-highway bench merger --noise 1e-5 1e-3 1e-1
      ms-highway bench dense_merge --noise 1e-5 1e-3 --set ladder=naive, --set humans=2 --json noise.json
      ms-highway bench merger --noise 0.1 --seen
      ms-highway bench road merge --drivers priced idm
    """
    from ms_highway.benchmarks.latency import bench, bench_several
    from ms_highway.benchmarks.steadiness import steadiness
    from ms_highway.benchmarks.throughput import throughput
    from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, environment_id
    from ms_highway.experiments.comparison import Comparison, paper_controllers
    from ms_highway.planning.human_models import rung_names
    from ms_highway.runtime.files import write_json

    if options.noise and (options.batches or options.crowd):
        raise ValueError("--noise is about driving, and --batches and --crowd about time; leave one out")
    own = any(each is not None for each in (options.seeds, options.seed, options.controllers)) or options.seen
    if not options.noise and own:
        raise ValueError("--seen, --seeds, --seed and --controllers are about --noise; give it, or leave them out")
    if options.devices and not (options.batches or options.noise):
        raise ValueError("--devices is about --batches and --noise; give one of them, or leave it out")
    config, results, tables = configuration(options), dict[str, dict[str, Any]](), []
    scenarios = list(dict.fromkeys(options.scenarios or PAPER_SCENARIOS))
    for scenario in scenarios:
        environment_id(scenario)  # refuses unknown ones before anything is measured
    if options.noise:
        ladders = {scenario: config.get("ladder", SCENARIOS[scenario].ladder) for scenario in scenarios}
        controllers = {scenario: options.controllers or rung_names(ladder) for scenario, ladder in ladders.items()}
        asked = Comparison(controllers, options.seeds or STARTS, options.seed or 0, config)
    with telling() as tell:
        for scenario in scenarios:
            if options.noise:
                noises, table = list(dict.fromkeys(options.noise)), _steadiness_table
                measured = steadiness(asked, scenario, noises, options.devices, options.modules, options.seen)
            elif options.batches:
                loops, table = (options.batches, options.devices, options.modules, config), _throughput_table
                measured = throughput(scenario, paper_controllers(scenario), *loops)
            elif SCENARIOS[scenario].streams:
                measured, table = bench_several(scenario, options.crowd or [1, 6, 8], config), _crowd_table
            else:
                measured, table = bench(scenario, **config), _latency_table
            results[scenario] = {}
            for name, result in measured:
                tell(f"measured {scenario}, {name}")
                results[scenario][name] = result
            tables.append(table(scenario, results[scenario]))
    print_tables(*tables)
    if options.json:
        write_json(options.json, results)


def _latency_table(scenario: str, measured: Mapping[str, Any]) -> "Table":
    mean = sum(one["plan_us"]["p50"] for one in measured.values()) / len(measured)
    for one in measured.values():
        one["of_mean_plan"] = one["decision_us"] / mean
    return _table(f"{scenario}: medians, on one core; us: microseconds", measured, LATENCY)


def _crowd_table(scenario: str, measured: Mapping[str, Any]) -> "Table":
    return _table(f"{scenario}: ms of a plan on one core, median (p99)", measured, CROWD)


def _throughput_table(scenario: str, measured: Mapping[str, Any]) -> "Table":
    first = next(iter(measured.values()))
    rows = {}
    for name, one in measured.items():
        batches = {f"batch {size}": steps for size, steps in one["batch"].items()}
        rows[name] = {"environment": one["environment"], "MiB": max(one["memory_mib"].values()), **batches}
    forms = {
        "environment": "{environment:,.0f}",
        **{f"batch {size}": f"{{batch {size}:,.0f}}" for size in first["batch"]},
    }
    title = f"{scenario}: steps of the closed loop per second; batches on {first['devices']}"
    return _table(title, rows, {**forms, "MiB": "{MiB:,.0f}"})


def _steadiness_table(scenario: str, measured: Mapping[str, Any]) -> "Table":
    from ms_highway.benchmarks.steadiness import AFTER

    first = next(iter(measured.values()))
    forms = {str(step): f"{{p50 {step}:two}} ({{p95 {step}:two}})" for step in AFTER}
    rows = {}
    for name, one in measured.items():
        for noise, figures in one["noise"].items():
            changes = figures["change_m"].items()
            moved = {f"{quantile} {step}": 1e3 * metres for step, one in changes for quantile, metres in one.items()}
            rows[f"{name}, noise {noise}"] = {**figures, **moved}
    what = f"mm from the undisturbed path after 1 to 20 steps, median (95 %) of {first['seeds'][1]} starts"
    what += ", by noise in what the robot sees" if first["seen"] else ""
    return _table(f"{scenario}: {what}", rows, {**forms, **STEADY})


def _table(title: str, measured: Mapping[str, Any], forms: Mapping[str, str]) -> "Table":
    """Return a table of what was measured, a row for each name, in columns of these forms."""
    from ms_highway.visualization.tables import grid, texts

    return grid(title, texts({"": "{name}", **forms}, [{"name": name, **one} for name, one in measured.items()]))
