"""The command ``ms-highway compare``."""

import argparse
import typing
from pathlib import Path
from typing import Any

from ms_highway import experiment, report
from ms_highway.cli_options import CONTROLLERS, add_costs, add_semantics, costs, human_reward
from ms_highway.console import add_command, count_episodes, print_tables
from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS
from ms_highway.figures import figures
from ms_highway.files import replacing
from ms_highway.planner import Solver
from ms_highway.provenance import add_run, read_runs, this_run
from ms_highway.results import read_results

__all__ = ["add_compare", "comparison"]

HELP = """\
Run the same seeded episodes with several controllers and compare reward and computation.

A controller is a human model that plans every step (naive, turn, tom); or switching:LAMBDA, which chooses the model at
every step and pays LAMBDA reward for a second of planning; or schedule:MODEL=STEPS,...,MODEL, an order that is fixed
beforehand, such as schedule:tom=6,naive. Without scenarios and controllers, the paper's comparison runs: its three
scenarios, each with its ladder and the paper's two lambdas.

Results go to --out: steps.csv (a row per step, written as episodes end), summary.csv, and per scenario the figures
SCENARIO_bars.png, _timeline.png, _curve.png (reward against computation) and _decisions.png; settings.json and
provenance.json say what they were made with. Stopped and started again with the same --out, it goes on where it was;
with more controllers or scenarios, it adds them. `ms-highway report` makes a page of them."""

EXAMPLES = """\
examples:
  ms-highway compare
  ms-highway compare merger --controllers naive tom switching:0.1 --seeds 10 --out results/merger
  ms-highway compare merger --controllers tom switching:{0.01,0.1} schedule:tom={4,6,8},naive --out results/curve
  ms-highway compare merger --ladder naive tom --controllers switching:0.1 --out results/two_rungs
  ms-highway compare give_way --semantics released --costs measured --out results/measured
  ms-highway compare stay_back --controllers naive turn --solver newton --seeds 100 --out results/newton"""


def add_compare(commands: Any) -> None:
    """Add the command ``compare`` to a parser's subparsers."""
    parser = add_command(commands, "compare", "compare controllers over many episodes", HELP, EXAMPLES)
    parser.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help=f"{', '.join(SCENARIOS)} (default: the paper's)"
    )
    parser.add_argument(
        "--controllers",
        nargs="+",
        metavar="CONTROLLER",
        help=f"{CONTROLLERS} (default: the paper's)",
    )
    parser.add_argument("--seeds", type=int, default=30, help="episodes per controller, seeded 0, 1, ... (default: 30)")
    parser.add_argument(
        "--ladder", nargs="+", metavar="MODEL", help="models to switch among, cheapest first (default: the scenario's)"
    )
    add_semantics(parser)
    parser.add_argument(
        "--solver",
        choices=typing.get_args(Solver),
        default="gradient",
        help="how the robot improves its plans under naive and turn: gradient, the paper's 20 steps (default), or "
        "newton, second-order steps with a line search; tom always takes gradient steps",
    )
    add_costs(parser)
    parser.add_argument(
        "--out", type=Path, default=Path("results/compare"), help="directory of results (default: results/compare)"
    )
    parser.set_defaults(run=_compare)


def comparison(options: argparse.Namespace) -> experiment.Comparison:
    """What the options of ``ms-highway compare`` ask for, checked.

    Raises:
        ValueError: naming what cannot be compared.
    """
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; there must be at least one episode")
    scenarios = list(dict.fromkeys(options.scenarios)) or list(PAPER_SCENARIOS)
    chosen = list(dict.fromkeys(options.controllers or []))
    asked = experiment.Comparison(
        {name: chosen or experiment.paper_controllers(name) for name in scenarios},
        options.seeds,
        options.semantics,
        costs(options.costs),
        options.solver,
        human_reward(options.human_reward),
        options.ladder,
    )
    asked.check()
    return asked


def _compare(options: argparse.Namespace) -> None:
    asked = comparison(options)
    read_runs(options.out)  # refuses what cannot be read before anything is run
    counts, wanted = experiment.run(asked, options.out), len(list(asked.episodes()))
    already = next(counts)
    if already < wanted:
        add_run(options.out, this_run(options.command_line))
    count_episodes(counts, already, wanted)
    summaries = report.summary(experiment.read(asked, options.out))
    for scenario in asked.controllers:
        print_tables(report.table(summaries, scenario))
    results = read_results(options.out)  # of this command and of those before
    with replacing(options.out / "summary.csv") as path:
        results.summaries.to_csv(path, index=False)
    for scenario in asked.controllers:
        for name, figure in figures(results.records, results.summaries, scenario).items():
            with replacing(options.out / f"{scenario}_{name}.png") as path:
                figure.savefig(path, dpi=110)
    print(f"results are in {options.out}")
