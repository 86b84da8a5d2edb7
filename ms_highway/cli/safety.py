"""The command ``ms-highway safety``."""

import argparse
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.options import (
    MOST,
    add_controllers,
    add_costs,
    add_devices,
    add_out,
    add_scenarios,
    add_semantics,
    asked_comparison,
    check_least,
    check_most,
    control_limit,
    controllers_by_scenario,
)

if TYPE_CHECKING:
    from ms_highway.experiments.safety import Limit

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
    add_scenarios(parser)
    add_controllers(parser)
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
    add_out(parser, "results/safety")
    parser.set_defaults(run=_safety, simulates=True)


def _safety(options: argparse.Namespace) -> None:
    from rich.box import SIMPLE
    from rich.table import Table

    from ms_highway.cli.results_directory import own_results
    from ms_highway.experiments.safety import SAFETY_FILE, count, read_safety, safety_cells, safety_sentences
    from ms_highway.runtime.files import replacing
    from ms_highway.simulation.devices import use_devices

    check_least(options, episodes=1, devices=1)
    check_most(options, episodes=MOST)
    comparison = asked_comparison(options, controllers_by_scenario(options), options.episodes)
    limits = [_limit(text) for text in options.limits]
    settings = {
        **comparison.common_config(),
        "costs": comparison.costs,
        "controllers": comparison.controllers,
        "limits": limits,
        "episodes": comparison.seeds,
    }
    with own_results(options, settings) as record:
        with telling() as tell:
            table = count(comparison, limits, use_devices(options.devices), tell)
        record()
        with replacing(options.out / SAFETY_FILE) as path:
            table.to_csv(path, index=False)
    safety = read_safety(options.out)
    texts = safety_cells(safety)
    grid = Table(title="episodes with a collision", box=SIMPLE, title_justify="left", title_style="bold")
    for column in texts:
        grid.add_column(column, justify="left" if column in ("scenario", "controller") else "right")
    for row in texts.itertuples(index=False):
        grid.add_row(*row)
    print_tables(grid)
    print("\n".join([*safety_sentences(safety), f"results are in {options.out}"]))


def _limit(text: str) -> "Limit":
    """Return a limit that ``--limits`` names.

    Raises:
        ValueError: if it is none.
    """
    return None if text == "default" else control_limit("--limits", text)
