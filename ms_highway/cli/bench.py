"""The command ``ms-highway bench``."""

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ms_highway.cli.command import command, number, option, output
from ms_highway.cli.console import print_tables, tell
from ms_highway.cli.options import DEVICES, MOST_SEEDS, SCENARIOS, SET, configuration, controllers

if TYPE_CHECKING:
    from pandas import DataFrame

NOISES = 1e-5, 10.0  # m, what single precision still tells apart, and the most
STARTS = 24


@command(
    "bench",
    "measure planning time, the closed loop, and steadiness",
    SCENARIOS,
    controllers("(default: all models of the ladder, and but for --noise switching)"),
    number("--batches", None, "measure such batches of simulated episodes, too", nargs="+", metavar="SIZE"),
    number("--noise", None, "measure steadiness under such noise instead", *NOISES, nargs="+", metavar="NOISE"),
    option("--seen", "put the --noise into what the robot sees in every step", action="store_true"),
    number("--seeds", None, f"starts to add --noise to (default: {STARTS})", 2),
    number("--seed", None, "of the first start (default: 0)", 0, MOST_SEEDS),
    DEVICES,
    SET,
    output("--json", "write all figures to a JSON file"),
)
def bench(options: argparse.Namespace) -> None:
    """Measure live episodes of every controller on one core, warm: a plan, a decision, the rest of a step without the
    plans of all cars, in microseconds, and steps per second. With --batches, measure the simulation of many episodes
    at once, too, by batch size, on --devices: steps per second, and MiB, the most memory that it has taken until then.

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
      ms-highway bench dense_merge --set humans=12 --controllers naive tom --json bench.json
      ms-highway bench merger --batches 1 16 64 256 1024 8192
      ms-highway bench merger --noise 1e-5 1e-3 1e-1
      ms-highway bench dense_merge --noise 1e-5 1e-3 --set ladder=naive, --set humans=2 --json noise.json
      ms-highway bench merger --noise 0.1 --seen
      ms-highway bench road merge --drivers priced idm
    """
    from ms_highway.benchmarks.speed import speed
    from ms_highway.benchmarks.steadiness import steadiness
    from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, environment_id
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.planning.human_models import rung_names
    from ms_highway.runtime.files import write_json

    if options.noise and options.batches:
        raise ValueError("--noise is about driving, and --batches about time; leave one out")
    if not options.noise and (options.seen or options.seeds is not None or options.seed is not None):
        raise ValueError("--seen, --seeds and --seed are about --noise; give it, or leave them out")
    if options.devices and not (options.batches or options.noise):
        raise ValueError("--devices is about --batches and --noise; give one of them, or leave it out")
    config, asked = configuration(options), dict[str, list[str]]()
    for scenario in options.scenarios or PAPER_SCENARIOS:
        environment_id(scenario)  # refuses unknown ones before anything is measured
        rungs = rung_names(config.get("ladder", SCENARIOS[scenario].ladder))
        switching = [] if options.noise else [f"switching:{price:g}" for price in SCENARIOS[scenario].prices]
        asked[scenario] = options.controllers or [*rungs, *switching]
    comparison = Comparison(asked, options.seeds or STARTS, options.seed or 0, config)
    results: dict[str, dict[str, Any]] = {scenario: {} for scenario in asked}
    for scenario, names in asked.items():
        if options.noise:
            noises = list(dict.fromkeys(options.noise))
            found = steadiness(comparison, scenario, noises, options.devices, options.modules, options.seen)
        else:
            found = speed(scenario, names, config, options.batches or [], options.devices, options.modules)
        for name, result in found:
            tell(f"measured {scenario}, {name}")
            results[scenario][name] = result
    table = _steadiness_table if options.noise else _speed_table
    print_tables(*(table(scenario, measured) for scenario, measured in results.items()))
    if options.json:
        write_json(options.json, results)


def _speed_table(scenario: str, measured: Mapping[str, Any]) -> "DataFrame":
    from ms_highway.visualization.tables import grid

    rows = []
    for name, one in measured.items():
        row = {"": name, "plan us": f"{one['plan_us']['p50']:.0f}", "p99": f"{one['plan_us']['p99']:.0f}"}
        row |= {"decision us": f"{one['decision_us']:.0f}", "step us": f"{one['step_us']:.0f}"}
        row["steps /s"] = f"{one['environment']:,.0f}"
        if "batch" in one:
            row |= {f"batch {size}": f"{rate:,.0f}" for size, rate in one["batch"].items()}
            row["MiB"] = f"{max(one['memory_mib'].values()):,.0f}"
        rows.append(row)
    devices = {one["devices"] for one in measured.values() if "devices" in one}
    batches = f"; steps per second of batches on {', '.join(devices)}" if devices else ""
    return grid(f"{scenario}: medians, on one core{batches}", rows)


def _steadiness_table(scenario: str, measured: Mapping[str, Any]) -> "DataFrame":
    from ms_highway.visualization.tables import grid

    first, rows = next(iter(measured.values())), []
    for name, one in measured.items():
        for noise, found in one["noise"].items():
            reward, (without, noisy) = found["reward"], found["collisions"]
            row = {"": f"{name}, noise {noise}"}
            for step, moved in found["change_m"].items():
                row[step] = f"{1e3 * moved['p50']:.2g} ({1e3 * moved['p95']:.2g})"
            row["growth"] = f"{found['growth']:.2f}"
            row["reward /step"] = f"{reward['mean']:+.3f} ({reward['low']:+.3f}, {reward['high']:+.3f})"
            row |= {"|reward|": f"{reward['absolute']:.2g}", "collisions": f"{without} -> {noisy}"}
            if found["success_changes"] is not None:
                row["success changed"] = f"{found['success_changes']:.0%}"
            rows.append(row)
    what = f"mm from the undisturbed path after 1 to 20 steps, median (95 %) of {first['seeds'][1]} starts"
    what += ", by noise in what the robot sees" if first["seen"] else ""
    return grid(f"{scenario}: {what}", rows)
