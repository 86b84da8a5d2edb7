"""The command ``ms-highway bench road``."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.benchmarks.road.names import DRIVERS, SCENES, check_drivers, known_scenes
from ms_highway.cli.console import Command, draw_unseen, print_tables
from ms_highway.cli.options import MOST, MOST_PROCESSES, MOST_SEEDS, check_least, check_most

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["add_bench_road"]

HELP = """\
Drive stock scenes of highway-env with this package's drivers and with others, from the same starts, and compare how
they fare. Each driver in each scene has a process of its own, on one core.

Success means, without a crash: merge, the ramp is passed; roundabout, the ring is left by the ego's exit within the
episode; exit and intersection, what highway-env says (is_success, has_arrived); elsewhere, the ego has stayed on the
road until the end. A car that stands still never crashes: read collisions beside success. The ego is not at fault where
it was rear-ended in a lane that it had kept for a second. |a| is the largest acceleration in any frame of the
simulation [m/s^2], jerk the root mean square [m/s^3], ms the time of a decision, without compilation.

Drivers of this package: switching, switching:LAMBDA, budget:MILLISECONDS, fixed:RUNG (naive, idm, turn, tom) and
proposals, which refines nothing; with +traits, the desired speed and headway of each car are estimated, with +belief,
the model that its driver follows (such as switching+traits+belief). Others: idm, highway-env's IDM and MOBIL in the
place of the ego; idle, which keeps speed and lane; random, which chooses the environment's actions by chance; dqn, DQN
of stable-baselines3 in the setting of highway-env's documentation (needs the extra "learning"). Drivers above 10 m/s^2
are labelled unphysical."""

EXAMPLES = """\
examples:
  ms-highway bench road merge --drivers switching idm
  ms-highway bench road --seeds 100 --seed 1000 --json road.json --log road.csv
  ms-highway bench road roundabout --drivers switching fixed:naive --traffic commuter --films films"""

TRAFFIC_NAMES = ("idm", "commuter", "unyielding")
"""The names of `ms_highway.benchmarks.road.episodes.TRAFFIC`; listed here so that help needs no JAX."""


def add_bench_road(bench: Command) -> None:
    """Add the command ``road`` to the command ``bench``."""
    parser = bench.add_branch("road", HELP, EXAMPLES)
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help=f"stock environments, -v0 if not said (default: {' '.join(SCENES)})"
    )
    parser.add_argument(
        "--drivers", nargs="+", metavar="DRIVER", default=DRIVERS, help=f"what drives (default: {' '.join(DRIVERS)})"
    )
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="episodes of each (default: 20)")
    parser.add_argument("--seed", type=int, default=0, metavar="FIRST", help="of the first episode (default: 0)")
    parser.add_argument(
        "--traffic",
        choices=TRAFFIC_NAMES,
        default="idm",
        help="highway-env's IDM (default), learned commuters, or IDM that never yields to the ego",
    )
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at once (default: number of cores)")
    parser.add_argument("--dqn-steps", type=int, default=20_000, metavar="N", help="of training (default: 20000)")
    parser.add_argument(
        "--models",
        type=Path,
        default=Path("results") / "dqn",
        metavar="DIR",
        help="where trained agents are kept (default: results/dqn)",
    )
    parser.add_argument("--films", type=Path, metavar="DIR", help="film the first success and failure of each driver")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures to a JSON file")
    parser.add_argument("--log", type=Path, metavar="FILE", help="write a row per episode to a CSV file")
    parser.set_defaults(run=_bench_road)


def _bench_road(options: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from ms_highway.benchmarks.road.blocks import run_blocks
    from ms_highway.benchmarks.road.episodes import Block, Episode
    from ms_highway.benchmarks.road.summary import row, summary

    check_least(options, seeds=1, seed=0, jobs=1, dqn_steps=1)
    check_most(options, seeds=MOST, seed=MOST_SEEDS - MOST, jobs=MOST_PROCESSES, dqn_steps=MOST)
    scenes, drivers = known_scenes(options.scenes or SCENES), list(dict.fromkeys(options.drivers))
    check_drivers(drivers, scenes)
    draw_unseen()
    blocks = [
        Block(scene, driver, options.traffic, options.dqn_steps, options.models)
        for scene in scenes
        for driver in drivers
    ]
    seeds = range(options.seed, options.seed + options.seeds)
    episodes: dict[Block, list[Episode]] = {block: [] for block in blocks}
    results: dict[str, dict[str, Any]] = {}
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("driving", total=len(blocks) * len(seeds))
        for block, episode in run_blocks(blocks, seeds, options.jobs, options.films, options.modules):
            episodes[block].append(episode)
            progress.update(task, advance=1, description=f"{block.scene}, {block.driver}")
            if len(episodes[block]) == len(seeds):  # what is done is kept, whatever happens next
                done = [one for one in blocks if len(episodes[one]) == len(seeds)]
                results = {one.scene: {} for one in done}
                for one in done:
                    results[one.scene][one.driver] = summary(one, episodes[one])
                _write(options, results, [row(one, episode) for one in done for episode in episodes[one]])
    print_tables(*(_table(scene, drivers, len(seeds)) for scene, drivers in results.items()))


def _write(options: argparse.Namespace, results: dict[str, dict[str, Any]], rows: list[dict[str, Any]]) -> None:
    """Write figures and episodes to the files that options name."""
    import pandas as pd

    from ms_highway.runtime.files import replacing

    if options.json:
        with replacing(options.json) as path:
            path.write_text(json.dumps(results, indent=2) + "\n")
    if options.log:
        with replacing(options.log) as path:
            pd.DataFrame(rows).to_csv(path, index=False)


def _table(scene: str, drivers: dict[str, dict[str, Any]], episodes: int) -> "Table":
    """Tabulate how drivers fared in a scene."""
    from rich.box import SIMPLE
    from rich.table import Table

    grid = Table(box=SIMPLE, title=f"{scene}: {episodes} episodes", title_justify="left")
    names = (
        "success",
        "crashes\n(at fault)",
        "off\nroad",
        "reward\n/step",
        "return",
        "m/s",
        "|a|",
        "jerk",
        "ms p50\n(p99)",
    )
    for column in ("driver", "", *names):
        grid.add_column(column, justify="right" if column in names else "left", no_wrap=True)
    for driver, figures in drivers.items():
        times = "" if figures["p50_ms"] is None else f"{figures['p50_ms']:.2f} ({figures['p99_ms']:.2f})"
        grid.add_row(
            driver,
            figures["label"],
            f"{figures['success']:.0%}",
            f"{figures['collisions']} ({figures['at_fault']})",
            f"{figures['off_road']:.0%}",
            f"{figures['reward_per_step']:.3f}",
            f"{figures['return']:.1f}",
            f"{figures['mean_speed']:.1f}",
            f"{figures['max_acceleration']:.1f}",
            f"{figures['jerk']:.1f}",
            times,
        )
    return grid
