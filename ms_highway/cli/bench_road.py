"""The command ``ms-highway bench road``."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ms_highway.benchmarks.road import (
    DRIVERS,
    EGOS,
    HUMAN,
    REACTIVE,
    RECORDED,
    RECORDED_TRAFFIC,
    SCENES,
    SEARCH,
    TRAFFIC,
    is_agent,
    known_scenes,
)
from ms_highway.cli.console import add_command, count_episodes, draw_unseen, print_tables
from ms_highway.cli.options import MOST_PROCESSES, MOST_SEEDS, add_number
from ms_highway.runtime.extras import needing

HELP = """\
Drive stock scenes of highway-env with this package's drivers and with others, from the same starts, and compare how
they fare. Each driver in each scene has a process of its own, on one core.

Success means, without a crash: merge, the ramp is passed; roundabout, the ring is left by the ego's exit within the
episode; exit and intersection, what highway-env says (is_success, has_arrived); elsewhere, the ego has stayed on the
road until the end. A car that stands still never crashes: read collisions beside success. The ego is not at fault where
it was rear-ended in a lane that it had kept for a second. Intervals of success are Wilson's; m/s² is the largest
acceleration in any frame of the simulation, jerk the root mean square, ms the time of a decision, without compilation,
late the share of plans that were not ready within a budget. Choices count the time of models at what the package ships.

Drivers of this package: priced, priced:LAMBDA, budget:MILLISECONDS and fixed:RUNG (naive, idm, tom); with
+intentions (such as priced+intentions), other cars show which way they take, as by indicators: their true routes,
where they have one. Others: idm, highway-env's IDM and MOBIL in the place of the ego; idle, which keeps speed and lane;
random, which chooses the environment's actions by chance; search, a beam search over copies of the environment that
knows all that will happen, within the tyres of this package's drivers: privileged, about half a minute for an episode,
which may last 60 s; or the file of an agent that stable-baselines3 has saved (it has to be installed), such as
notebooks/examples/train_peers.py writes: open only files that you trust, as they may hold any program. Drivers above 10
m/s^2 are labelled unphysical.
With a search, or its log as --bound, the table says how others fare from the same starts: solved, the share of those
that the search solves which they solve, too; regret, what they earn less per step, to be read beside crashes, which cut
episodes short (the search need not find the best); waited, the time that they stood longer, in seconds, where both
solve the start.

The scene "recorded" has the planning problems of CommonRoad scenarios (--data; by default that of the package), or,
with --egos changing, a start in the place of every vehicle that was recorded to change lanes: it has to be where that
was last. Its --traffic: learned drivers who react (default), replay, or idm. Success is CommonRoad's: the goal's region
reached in its interval of time, without a collision and on the road; "s to goal" is the mean. There, --seed and
--seeds are the number of the first start and how many. Further drivers there: human, who goes as the vehicle was
recorded to whose place it takes; reactive, commonroad-reactive-planner, to which the recorded future of all others is
known: privileged; reactive-default, the same with its own settings. --export DIR writes every drive as a CommonRoad
scenario and solution; with --judge, commonroad-drivability-checker judges these: it agrees where both say the same of
success, collision and road, and says which drives CommonRoad's vehicle could have made: feasible."""

EXAMPLES = """\
examples:
  ms-highway bench road merge --drivers priced idm
  ms-highway bench road --seeds 100 --seed 1000 --json road.json --log road.csv
  ms-highway bench road roundabout --drivers priced fixed:naive --traffic commuter --films films
  ms-highway bench road intersection-v0 --drivers search --seeds 20 --log search.csv
  ms-highway bench road merge-v0 --drivers priced agents/dqn-merge-v0-0.zip
  ms-highway bench road intersection-v0 --drivers priced idm --seeds 20 --bound search.csv
  ms-highway bench road recorded
  ms-highway bench road recorded --data us101 --traffic replay --drivers priced idm reactive --export drives --judge"""


def add_bench_road(commands: Any) -> None:
    """Add the command ``bench road`` to a parser's subparsers."""
    parser = add_command(commands, "bench road", "measure drivers in highway-env's own scenes", HELP, EXAMPLES)
    parser.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help=f"stock environments, all versions if none is said (default: {' '.join(SCENES)})",
    )
    parser.add_argument(
        "--drivers", nargs="+", metavar="DRIVER", default=DRIVERS, help=f"what drives (default: {' '.join(DRIVERS)})"
    )
    add_number(parser, "--seeds", None, "episodes of each (default: 20; in recordings, all)")
    add_number(parser, "--seed", 0, "of the first episode", least=0, most=MOST_SEEDS)
    traffic = (
        "highway-env's IDM (default), its aggressive drivers, learned commuters, or IDM that never yields to the ego; "
        "in recordings: learned (default), replay or idm"
    )
    kinds = list(dict.fromkeys([*TRAFFIC, *RECORDED_TRAFFIC]))
    parser.add_argument("--traffic", choices=kinds, default=None, help=traffic)
    parser.add_argument("--data", type=Path, metavar="DIR", help="CommonRoad scenarios, for the scene recorded")
    parser.add_argument("--egos", choices=EGOS, help="whose place the ego takes in recordings (default: problem)")
    parser.add_argument("--judge", action="store_true", help="let an outside judge check exported drives")
    add_number(parser, "--jobs", None, "processes at once (default: number of cores)", most=MOST_PROCESSES)
    for name, metavar, text in (
        ("--export", "DIR", "write drives in recordings as CommonRoad scenarios and solutions"),
        ("--films", "DIR", "film the first success and failure of each driver"),
        ("--bound", "FILE", "compare with the search in a log that --log has written"),
        ("--json", "FILE", "write all figures to a JSON file"),
        ("--log", "FILE", "write a row per episode to a CSV file"),
    ):
        parser.add_argument(name, type=Path, metavar=metavar, help=text)
    parser.set_defaults(run=_bench_road)


def _bench_road(options: argparse.Namespace) -> None:
    import pandas as pd

    from ms_highway.benchmarks.road.blocks import run_blocks
    from ms_highway.benchmarks.road.bound import behind, bound_of, read_bounds
    from ms_highway.benchmarks.road.episodes import Block, Episode, check_driver, make_driver, row, summary
    from ms_highway.cli.results_directory import write_table
    from ms_highway.control.road import SHIPPED_COSTS
    from ms_highway.planning.road.settings import MODELS
    from ms_highway.runtime.files import write_json
    from ms_highway.visualization.roads import driver_table, fared

    scenes, drivers = known_scenes(options.scenes or SCENES), list(dict.fromkeys(options.drivers))
    for driver in drivers:
        check_driver(driver)
    starts = _starts(options, scenes, drivers)
    traffic = options.traffic or (RECORDED_TRAFFIC[0] if starts else "idm")
    given = tuple(starts), options.export, options.judge
    blocks = [Block(scene, driver, traffic, *given) for scene in scenes for driver in drivers]
    for block in blocks:
        if block.driver == SEARCH or is_agent(block.driver):
            make_driver(block).close()  # or refuse scenes that are not for it
    seeds = range(options.seed, options.seed + (options.seeds or 20))
    if starts:
        seeds = range(len(starts))[options.seed :][: options.seeds]
    bounds = read_bounds(options.bound, traffic) if options.bound else {}
    if options.bound and not any(seed in bounds.get(scene, {}) for scene in scenes for seed in seeds):
        raise ValueError(f"--bound: {options.bound} has no start of these scenes and seeds")
    if options.bound and options.log and options.bound.resolve() == options.log.resolve():
        raise ValueError(f"--log would overwrite {options.bound}, which is the bound; give another file")
    draw_unseen()
    episodes: dict[Block, list[Episode]] = {block: [] for block in blocks}
    results: dict[str, dict[str, Any]] = {scene: {} for scene in scenes}

    def driven() -> Iterator[int]:
        runs = run_blocks(blocks, seeds, options.jobs, options.films, options.modules)
        for count, (block, episode) in enumerate(runs, start=1):
            episodes[block].append(episode)
            yield count
            if len(episodes[block]) == len(seeds):  # what is done is kept, whatever happens next
                own = {block.driver: summary(block, episodes[block])} | results[block.scene]
                results[block.scene] = {driver: own[driver] for driver in drivers if driver in own}
                if options.json:
                    write_json(options.json, results)
                if options.log:
                    done = [one for one in blocks if one.driver in results[one.scene]]
                    rows = [row(one, episode) for one in done for episode in episodes[one]]
                    write_table(pd.DataFrame(rows), options.log)

    count_episodes(driven(), 0, len(blocks) * len(seeds))
    if SEARCH in drivers:
        bounds |= {scene: bound_of(episodes[Block(scene, SEARCH, traffic)]) for scene in scenes}
    for block in blocks:
        results[block.scene][block.driver] |= behind(episodes[block], bounds.get(block.scene, {}))
    if bounds and options.json:
        write_json(options.json, results)
    costs = zip(MODELS, 1e3 * SHIPPED_COSTS.each, strict=True)
    counted = ", ".join(f"{name} {milliseconds:.2g}" for name, milliseconds in costs)
    for scene, figures in fared(results).items():
        heading = f"{scene}, traffic {traffic}: {len(seeds)} episodes; choices count {counted} ms a car"
        print_tables(driver_table(heading, figures, "traffic", "episodes"))  # which the heading says


def _starts(options: argparse.Namespace, scenes: list[str], drivers: list[str]) -> list[Any]:
    """Return the starts in recordings; none in other scenes.

    Raises:
        ValueError: for options that do not go together.
    """
    if RECORDED not in scenes:
        given = {"--data": options.data, "--egos": options.egos, "--export": options.export, "--judge": options.judge}
        given |= {driver: driver in drivers for driver in (HUMAN, *REACTIVE)}
        for name in [name for name, value in given.items() if value]:
            raise ValueError(f"{name} is for the scene {RECORDED!r} only: ms-highway bench road {RECORDED} ...")
        if options.traffic is not None and options.traffic not in TRAFFIC:
            known = ", ".join(TRAFFIC)
            raise ValueError(f"--traffic {options.traffic} is for the scene {RECORDED!r}; choose one of {known}")
        return []
    if scenes != [RECORDED]:
        raise ValueError(f"the scene {RECORDED!r} has traffic and starts of its own; measure it in a command by itself")
    if options.traffic is not None and options.traffic not in RECORDED_TRAFFIC:
        known = ", ".join(RECORDED_TRAFFIC)
        raise ValueError(f"--traffic {options.traffic} is not for the scene {RECORDED!r}; choose one of {known}")
    egos = options.egos or EGOS[0]
    if SEARCH in drivers:
        raise ValueError(f"the driver {SEARCH} does not drive in recordings; leave it out")
    for driver in [driver for driver in drivers if driver in ({HUMAN} if egos == EGOS[0] else REACTIVE)]:
        raise ValueError(f"the driver {driver} does not drive with --egos {egos}; leave it out")
    if options.data is None and set(drivers) & set(REACTIVE):
        raise ValueError(f"the drivers {' and '.join(REACTIVE)} need files of recordings; give their directory, --data")
    if options.judge or set(drivers) & set(REACTIVE):
        with needing("judge"):
            import commonroad_dc  # noqa: F401  # or refuse before anything is driven
    if options.export and (options.data is None or egos != EGOS[0]):
        raise ValueError("--export writes solutions of planning problems of --data; give that, and no other --egos")
    if options.judge and not options.export:
        raise ValueError("--judge judges exported drives; say where they go: --export DIR")
    from ms_highway.benchmarks.road.recorded import starts_of

    starts = starts_of(options.data, egos)
    if options.seed >= len(starts):
        raise ValueError(f"--seed is {options.seed}, but there are {len(starts)} starts; give a smaller number")
    return starts
