"""The command ``ms-highway compare``."""

import argparse
import typing
from pathlib import Path
from typing import Any

from ms_highway.cli.console import add_command, count_episodes, print_tables
from ms_highway.cli.options import (
    CONTROLLERS,
    MOST,
    add_costs,
    add_planning,
    add_semantics,
    check_most,
    costs,
    human_reward,
    note_run,
    planning,
)
from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS
from ms_highway.experiments.comparison import Comparison, paper_controllers
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.results import read_results
from ms_highway.experiments.runner import read, run
from ms_highway.experiments.summary import summary
from ms_highway.optimization.solvers import Solver
from ms_highway.runtime.files import held, replacing, tidy
from ms_highway.visualization.comparison import table
from ms_highway.visualization.figures import CAPTIONS, figures

__all__ = ["add_compare", "comparison"]

HELP = """\
Run the same seeded episodes with several controllers and compare reward and computation.

A controller is a human model that plans every step (naive, turn, tom); or switching:LAMBDA, which chooses the model at
every step and pays LAMBDA reward for a second of planning; or schedule:MODEL=STEPS,...,MODEL, an order that is fixed
beforehand, such as schedule:tom=6,naive; or random:MODEL=SHARE,..., a model drawn for every step, such as
random:naive=0.7,tom=0.3: a choice that looks at nothing, which others have to beat. Without scenarios and controllers,
the paper's comparison runs: its three scenarios, each with its ladder and the paper's two lambdas.

Results go to --out: steps.csv (a row per step, written as episodes end), summary.csv, and per scenario the figures
SCENARIO_bars.png (of three lambdas or more _curve.png, reward against computation), _timeline.png and _decisions.png;
settings.json and provenance.json say what they were made with. Stopped and started again with the same --out, it goes
on where it was; with more controllers or scenarios, it adds them. `ms-highway report` makes a page of them."""

EXAMPLES = """\
examples:
  ms-highway compare
  ms-highway compare merger --controllers naive tom switching:0.1 --seeds 10 --out results/merger
  ms-highway compare merger --controllers tom switching:{0.01,0.1} schedule:tom={4,6,8},naive --out results/curve
  ms-highway compare merger --ladder naive tom --controllers switching:0.1 --out results/two_rungs
  ms-highway compare give_way --semantics released --costs measured --out results/measured
  ms-highway compare stay_back --controllers naive turn --solver newton --seeds 100 --out results/newton
  ms-highway compare merger --horizon 10 --control-limit 0.2,9 --out results/second"""


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
    add_planning(parser)
    parser.add_argument(
        "--out", type=Path, default=Path("results/compare"), help="directory of results (default: results/compare)"
    )
    parser.set_defaults(run=_compare)


def comparison(options: argparse.Namespace) -> Comparison:
    """What the options of ``ms-highway compare`` ask for, checked.

    Raises:
        ValueError: naming what cannot be compared.
    """
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; there must be at least one episode")
    check_most(options, seeds=MOST)
    scenarios = list(dict.fromkeys(options.scenarios)) or list(PAPER_SCENARIOS)
    chosen = list(dict.fromkeys(options.controllers or []))
    asked = Comparison(
        {name: chosen or paper_controllers(name) for name in scenarios},
        options.seeds,
        options.semantics,
        costs(options.costs),
        options.solver,
        human_reward(options.human_reward),
        options.ladder,
        planning=planning(options),
    )
    asked.check()
    return asked


def _compare(options: argparse.Namespace) -> None:
    asked = comparison(options)
    with held(options.out):
        _run(asked, options)
    print(f"results are in {options.out}")


def _run(asked: Comparison, options: argparse.Namespace) -> None:
    """Compare, and write and print what came of it."""
    read_runs(options.out)  # refuses what cannot be read before anything is run
    counts, wanted = run(asked, options.out), len(list(asked.episodes()))
    already = next(counts)
    tidy(options.out)
    if already < wanted:
        note_run(options)
    count_episodes(counts, already, wanted)
    summaries = summary(read(asked, options.out))
    for scenario in asked.controllers:
        print_tables(table(summaries, scenario))
    results = read_results(options.out)  # of this command and of those before
    with replacing(options.out / "summary.csv") as path:
        results.summaries.to_csv(path, index=False)
    for scenario in asked.controllers:
        drawn = figures(results.records, results.summaries, scenario)
        for name, figure in drawn.items():
            with replacing(options.out / f"{scenario}_{name}.png") as path:
                figure.savefig(path, dpi=110)
        for name in CAPTIONS.keys() - drawn.keys():  # what fewer controllers had
            (options.out / f"{scenario}_{name}.png").unlink(missing_ok=True)
