"""The command ``ms-highway safety``."""

import argparse
import json
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.table import Table

from ms_highway.cli.console import add_command, print_tables, work
from ms_highway.cli.options import (
    CONTROLLERS,
    MOST,
    add_costs,
    add_devices,
    add_semantics,
    check_least,
    check_most,
    control_limit,
    costs,
    human_reward,
    note_run,
)
from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS
from ms_highway.experiments.comparison import Comparison, paper_controllers
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.safety import SAFETY_FILE, Limit, count, read_safety, safety_cells, safety_told
from ms_highway.experiments.settings import SETTINGS_FILE, check_settings
from ms_highway.runtime.files import held, replacing, tidy
from ms_highway.runtime.jax_settings import high_throughput
from ms_highway.simulation.devices import use_devices

__all__ = ["add_safety"]

HELP = """\
Count the episodes in which the robot collides, under several limits on what plans of robot and human may ask of the
car: the curvature of its path and its acceleration. All controllers start from the same states; everything is
simulated.

Results go to --out: safety.csv (a row per scenario, controller and limit), settings.json and provenance.json.
`ms-highway report` shows them beside a comparison, when it is given this directory too."""

EXAMPLES = """\
examples:
  ms-highway safety
  ms-highway safety merger --controllers tom switching:0.1 --limits default 0.2,9 --out results/merger_safety
  ms-highway report results/compare results/safety"""

LIMITS = ["default", "0.2,9", "0.1,6"]


def add_safety(commands: Any) -> None:
    """Add the command ``safety`` to a parser's subparsers."""
    parser = add_command(commands, "safety", "count collisions under limits on plans", HELP, EXAMPLES)
    parser.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help=f"{', '.join(SCENARIOS)} (default: the paper's)"
    )
    parser.add_argument("--controllers", nargs="+", metavar="CONTROLLER", help=f"{CONTROLLERS} (default: the paper's)")
    parser.add_argument(
        "--limits",
        nargs="+",
        metavar="OMEGA,ACCELERATION",
        default=LIMITS,
        help="bounds like 0.2,9 [1/m (released semantics: rad/s), m/s^2]; default, those that belong to the semantics; "
        f"or unlimited (default: {' '.join(LIMITS)})",
    )
    parser.add_argument("--episodes", type=int, default=300, help="per controller and limit (default: 300)")
    add_semantics(parser)
    add_costs(parser, measured=False)
    add_devices(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        default=Path("results/safety"),
        help="directory of results (default: results/safety)",
    )
    parser.set_defaults(run=_safety, prepare=high_throughput)


def _safety(options: argparse.Namespace) -> None:
    check_least(options, episodes=1, devices=1)
    check_most(options, episodes=MOST)
    comparison, limits = _comparison(options), [_limit(text) for text in options.limits]
    settings = {
        **comparison.common_config(),
        "costs": comparison.costs,
        "controllers": comparison.controllers,
        "limits": limits,
        "episodes": comparison.seeds,
    }
    with held(options.out):
        check_settings(options.out, settings)
        read_runs(options.out)  # refuses what cannot be read before anything is run
        tidy(options.out)
        table = work(count(comparison, limits, use_devices(options.devices)))
        with replacing(options.out / SETTINGS_FILE) as path:
            path.write_text(json.dumps(settings, indent=2) + "\n")
        with replacing(options.out / SAFETY_FILE) as path:
            table.to_csv(path, index=False)
        note_run(options)
    safety = read_safety(options.out)
    texts = safety_cells(safety)
    grid = Table(title="episodes with a collision", box=SIMPLE, title_justify="left", title_style="bold")
    for column in texts:
        grid.add_column(column, justify="left" if column in ("scenario", "controller") else "right")
    for row in texts.itertuples(index=False):
        grid.add_row(*row)
    print_tables(grid)
    print("\n".join([*safety_told(safety), f"results are in {options.out}"]))


def _comparison(options: argparse.Namespace) -> Comparison:
    """The episodes.

    Raises:
        ValueError: naming what cannot be simulated.
    """
    scenarios = list(dict.fromkeys(options.scenarios)) or PAPER_SCENARIOS
    chosen = list(dict.fromkeys(options.controllers or []))
    return Comparison(
        {name: chosen or paper_controllers(name) for name in scenarios},
        options.episodes,
        options.semantics,
        costs(options.costs),
        human_reward=human_reward(options.human_reward),
    )


def _limit(text: str) -> Limit:
    """A limit that ``--limits`` names.

    Raises:
        ValueError: if it is none.
    """
    return None if text == "default" else control_limit("--limits", text)
