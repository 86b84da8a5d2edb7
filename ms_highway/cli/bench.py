"""Define the commands ``ms-highway bench`` and ``ms-highway bench road``."""

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from ms_highway.benchmarks.road import (
    DEFAULT_DRIVERS,
    EGOS,
    RECORDED,
    RECORDED_TRAFFIC,
    SCENES,
    TRAFFIC,
    known_scenes,
)
from ms_highway.cli.console import (
    command,
    number,
    option,
    output,
    print_tables,
    tell,
    telling_often,
)
from ms_highway.cli.options import (
    DEVICES,
    MAX_FIRST_SEED,
    SCENARIO_ARGUMENT,
    SET,
    controllers,
    read_comparison,
)

if TYPE_CHECKING:
    from ms_highway.benchmarks.road.episodes import Block
    from ms_highway.benchmarks.road.peers import RecordedStart

JSON = output("--json", "write all figures to a JSON file")


@command(
    "bench",
    "measure planning time and the closed loop",
    SCENARIO_ARGUMENT,
    controllers("(default: all models of the ladder, and switching)"),
    number(
        "--batches",
        [],
        "also measure batches of simulated episodes",
        nargs="+",
        metavar="SIZE",
    ),
    DEVICES,
    SET,
    JSON,
)
def bench(options: argparse.Namespace) -> None:
    r"""Measure live episodes of every controller on one core, warm.

    The table has the microseconds of a plan, of a decision and of the rest of a step
    (without the plans of all cars), and steps per second. With --batches, also measure
    the simulation of many episodes at once on --devices, by batch size: steps per
    second, and the largest memory so far in MiB.

    `ms-highway bench road` measures drivers in stock scenes of highway-env.

    Examples:
      ms-highway bench merger
      ms-highway bench dense_merge --set humans=12 --controllers naive tom \
        --json bench.json
      ms-highway bench merger --batches 1 16 64 256 1024 8192
      ms-highway bench road merge --drivers priced idm
    """
    from ms_highway.benchmarks.speed import batch_speed, live_speed
    from ms_highway.runtime.files import write_json
    from ms_highway.runtime.jax_settings import (
        high_throughput,
        low_latency_on_core,
        own_process,
    )
    from ms_highway.visualization.tables import speed_table

    comparison = read_comparison(options)
    devices = options.devices

    # How to set up JAX in a process of its own, and what to measure there.
    measures: list[tuple[Callable, Callable]] = [
        (partial(low_latency_on_core, 0), live_speed)
    ]
    if options.batches:
        sizes = sorted(options.batches)
        measure_batches = partial(batch_speed, sizes=sizes, devices=devices)
        measures.append((high_throughput, measure_batches))

    results: dict[str, dict[str, dict[str, float]]] = {}
    for scenario, names in comparison.controllers.items():
        results[scenario] = {name: {} for name in names}
    for (scenario, found), (configure, measure) in product(results.items(), measures):
        # The process is warm after its first controller.
        with own_process(configure, options.modules) as process:
            for name in found:
                figures = process.submit(measure, comparison, scenario, name).result()
                tell(f"measured {scenario}, {name}: {', '.join(figures)}")
                found[name] |= figures
    print_tables(
        *(speed_table(scenario, measured) for scenario, measured in results.items())
    )
    if options.json:
        write_json(options.json, results)


@command(
    "bench road",
    "measure drivers in highway-env's own scenes",
    option(
        "scenes",
        "stock environments; all versions of a name without version (default:"
        f" {' '.join(SCENES)})",
        nargs="*",
        metavar="SCENE",
    ),
    option(
        "--drivers",
        "drivers to compare",
        DEFAULT_DRIVERS,
        nargs="+",
        metavar="DRIVER",
    ),
    number(
        "--seeds", None, "episodes of each driver (default: 20; in recordings, all)"
    ),
    number("--seed", 0, "seed of the first episode", 0, MAX_FIRST_SEED),
    option(
        "--traffic",
        "the other drivers: idm, highway-env's (default); aggressive, its aggressive"
        " ones; or commuter, learned ones; in recordings: learned (default), replay or"
        " idm",
        choices=list(dict.fromkeys([*TRAFFIC, *RECORDED_TRAFFIC])),
        metavar="KIND",
    ),
    option(
        "--data",
        "CommonRoad scenarios, for the scene recorded",
        type=Path,
        metavar="DIR",
    ),
    option(
        "--egos", "starts of the ego in recordings (default: problem)", choices=EGOS
    ),
    output(
        "--export",
        "write drives of planning problems as CommonRoad files",
        directory=True,
    ),
    output(
        "--films", "film the first success and failure of each driver", directory=True
    ),
    JSON,
    output("--log", "write a row per episode to a CSV file"),
)
def bench_road(options: argparse.Namespace) -> None:
    r"""Compare drivers in stock scenes of highway-env, from the same starts.

    The drivers are of this package and others. Each driver in each scene has a process
    of its own, on one core.

    A drive without a crash succeeds if: in merge, the ego passes the ramp; in
    roundabout, it leaves the ring by its exit within the episode; in exit and
    intersection, highway-env says so (is_success, has_arrived); elsewhere, it stays on
    the road until the end. A car that stands still never crashes: compare collisions
    together with success. The ego is not at fault if it was rear-ended in a lane that
    it had kept for a second. Intervals of success are Wilson's; m/s² is the largest
    acceleration in any frame of the simulation, jerk the root mean square, ms the time
    of a decision without compilation, late the share of plans that exceeded a budget.
    Choices count the shipped times of the models.

    Drivers of this package are priced, priced:LAMBDA, budget:MILLISECONDS and
    fixed:RUNG (naive, idm, tom); with +intentions (such as priced+intentions), other
    cars that have a route show it, as by indicators. Your own are those that a module
    of --import adds: planners of add_driver, and agents of add_agent. Others are idm,
    highway-env's IDM and MOBIL instead of the ego; commuter, a CommuterVehicle instead
    of the ego; and files of agents that stable-baselines3 has saved (it has to be
    installed), such as those of notebooks/examples/train_peers.py: open only files that
    you trust, as they may hold any program. Drivers above 10 m/s^2 are labelled
    unphysical.

    Collisions are the ego's; "with any collision" counts the episodes in which any
    vehicles touch, "others m/s" is the mean speed of the other vehicles. To compare
    kinds of traffic, let the ego be of the same kind.

    The scene "recorded" has the planning problems of CommonRoad scenarios (--data; by
    default, that of the package). If the vehicle of a problem was recorded, too, the
    ego takes its place, and a line says so. With --egos changing, it has a start in the
    place of every vehicle that was recorded to change lanes; the goal is that vehicle's
    last position. Its --traffic is learned (drivers who react, the default), replay or
    idm. Success is CommonRoad's: to reach the goal's region in its interval of time,
    without a collision and on the road; "s to goal" is the mean time. There, --seed is
    the number of the first start and --seeds the number of starts, and there is a
    driver human, which repeats the recorded drive of the vehicle in whose place it
    starts. --export DIR writes every drive of a planning problem as two CommonRoad
    files, for example for commonroad-drivability-checker: DIR/TRAFFIC/DRIVER/NAME.xml,
    the recording with the other vehicles as they moved in the episode, and
    NAME.solution.xml, the ego's drive as states of a kinematic single-track model
    (KS2). In DRIVER and NAME, characters that have a meaning in paths, such as : and /,
    become _, and digits follow that keep different names apart.

    Examples:
      ms-highway bench road merge --drivers priced idm
      ms-highway bench road --seeds 100 --seed 1000 --json road.json --log road.csv
      ms-highway bench road roundabout --drivers priced fixed:naive --traffic commuter \
        --films films
      ms-highway bench road roundabout-v1 exit-v1 --drivers commuter \
        --traffic commuter --seeds 40
      ms-highway bench road merge-v0 --drivers priced agents/dqn-merge-v0-0.zip
      ms-highway --import notebooks.examples.agents bench road merge-v0 \
        --drivers merges idm
      ms-highway bench road recorded
      ms-highway bench road recorded --data us101 --traffic replay \
        --drivers priced idm --export drives
    """
    from ms_highway.benchmarks.road.episodes import Block, check_driver, make_driver
    from ms_highway.benchmarks.road.peers import RecordedStart, starts_of
    from ms_highway.envs.agents import is_agent
    from ms_highway.road.driver import MEASURED_COSTS
    from ms_highway.visualization.tables import driver_table

    scenes = known_scenes(options.scenes or SCENES)
    drivers = list(dict.fromkeys(options.drivers))
    for driver in drivers:
        check_driver(driver)
    traffic = _chosen_traffic(options, scenes)
    starts: tuple[RecordedStart, ...] = ()
    seeds = range(options.seed, options.seed + (options.seeds or 20))
    if scenes == [RECORDED]:
        starts = tuple(starts_of(options.data, options.egos or EGOS[0]))
        seeds = _chosen_starts(options, starts)
    blocks = [
        Block(scene, driver, traffic, starts, options.export)
        for scene in scenes
        for driver in drivers
    ]
    for block in blocks:
        # An agent refuses a scene that it does not fit.
        if is_agent(block.driver):
            make_driver(block).close()

    results = _drive_blocks(options, blocks, seeds)

    costs = zip(MEASURED_COSTS.names, MEASURED_COSTS.each, strict=True)
    counted = ", ".join(f"{name} {1e3 * seconds:.2g}" for name, seconds in costs)
    for scene, figures in results.items():
        heading = (
            f"{scene}, traffic {traffic}: {len(seeds)} episodes; choices count"
            f" {counted} ms a car"
        )
        print_tables(driver_table(heading, figures))


def _drive_blocks(
    options: argparse.Namespace,
    blocks: "Sequence[Block]",
    seeds: range,
) -> dict[str, dict[str, dict]]:
    """Drive all episodes, and write files after every block.

    Returns:
        The summary of every driver in every scene.
    """
    import pandas as pd

    from ms_highway.benchmarks.road.episodes import row, run_blocks, summary
    from ms_highway.experiments.directory import write_table
    from ms_highway.runtime.files import write_json

    rows: list[dict] = []
    results: dict[str, dict[str, dict]] = {block.scene: {} for block in blocks}

    def progress() -> str:
        """Say how many episodes are done."""
        return f"episodes: {len(rows)} of {len(blocks) * len(seeds)}"

    with telling_often(progress):
        driven = run_blocks(blocks, seeds, options.films, options.modules)
        for block, episodes in driven:
            tell(f"drove {block.scene}, {block.driver}")
            results[block.scene][block.driver] = summary(block, episodes)
            rows.extend(row(block, episode) for episode in episodes)
            # Write after every block, so that a later failure loses nothing.
            if options.json:
                write_json(options.json, results)
            if options.log:
                write_table(pd.DataFrame(rows), options.log)
    return results


def _chosen_traffic(options: argparse.Namespace, scenes: list[str]) -> str:
    """Return the kind of traffic of all scenes, and refuse options that they lack.

    Raises:
        ValueError: naming options or scenes that do not go together.
    """
    recorded = RECORDED in scenes
    if recorded and scenes != [RECORDED]:
        raise ValueError(
            f"the scene {RECORDED} has its own traffic and starts; name no other scene"
            " beside it"
        )
    if not recorded and (options.data or options.egos or options.export):
        raise ValueError(
            f"--data, --egos and --export need the scene {RECORDED}: ms-highway bench"
            f" road {RECORDED}"
        )
    if options.export and (options.egos == "changing" or not options.data):
        raise ValueError(
            "--export writes solutions of planning problems: give --data, and leave"
            " --egos out"
        )
    kinds = list(RECORDED_TRAFFIC if recorded else TRAFFIC)
    traffic = options.traffic or kinds[0]
    if traffic not in kinds:
        raise ValueError(
            f"--traffic {traffic} is not for {scenes[0]}; choose one of"
            f" {', '.join(kinds)}"
        )
    return traffic


def _chosen_starts(
    options: argparse.Namespace,
    starts: "Sequence[RecordedStart]",
) -> range:
    """Return the numbers of the recorded starts that ``--seed`` and ``--seeds`` choose.

    Tell in which of them the ego takes the place of another recorded vehicle.

    Raises:
        ValueError: if there is none.
    """
    numbers = range(len(starts))[options.seed :][: options.seeds]
    if not numbers:
        raise ValueError(
            f"--seed is {options.seed}, but there are {len(starts)} starts; give a"
            " smaller number"
        )
    replaced = []
    for place in numbers:
        start = starts[place]
        if start.replaced is not None and start.replaced != start.ego:
            replaced.append(f"{start.replaced} in {start.name}")
    if replaced:
        taken = ", ".join(replaced)
        tell(f"the ego takes the place of the recorded vehicle {taken}")
    return numbers
