"""The command ``ms-highway compare``."""

import argparse
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, count_episodes, print_tables
from ms_highway.cli.options import (
    CROWD_CONTROLLERS,
    CROWD_NAMES,
    MOST,
    SCENARIO_NAMES,
    SOLVERS,
    add_controllers,
    add_costs,
    add_humans,
    add_ladder,
    add_out,
    add_planning,
    add_scenarios,
    add_semantics,
    asked_comparison,
    check_most,
    controllers_by_scenario,
)

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison

__all__ = ["add_compare", "comparison"]

HELP = f"""\
Run the same seeded episodes with several controllers and compare reward and computation.

A controller is a human model that plans every step (naive, turn, tom); or learned:LAMBDA, which chooses the model at
every step by a learned value of computation, at a price of LAMBDA reward for a second of planning (learned:LAMBDA:FILE
with values of `ms-highway values learn`); or switching:LAMBDA, which chooses by the paper's Algorithm 1, or
horizon:LAMBDA, by gains that are estimated over the whole plan instead of one step; or schedule:MODEL=STEPS,...,MODEL,
an order that is fixed beforehand, such as schedule:tom=6,naive; or period:MODEL=STEPS,..., an order that is repeated,
such as period:tom=1,naive=3; or random:MODEL=SHARE,..., a model drawn for every step, such as random:naive=0.7,tom=0.3:
a choice that looks at nothing, which others have to beat. Without scenarios and controllers, the paper's comparison
runs: its three scenarios, each with its ladder and the paper's two lambdas.

In {" and ".join(CROWD_NAMES)}, a controller chooses a model for each of several humans: {CROWD_CONTROLLERS}. A model's
name stands for all humans; nearest:K, ttc:K and influence:K predict K humans by tom, the nearest, those with the
smallest time to collision, or those with the largest influence on the plan, and the others naively; budget:MILLISECONDS
chooses what is worth most within this time of planning and deciding per step.

Any controller with +belief at the end, such as tom+belief, infers from what each human does whether it is predicted by
naive, idm, turn or tom, and plans naively where a model would count on a response that the human does not show.

Results go to --out: steps.csv (a row per step, written as episodes end), summary.csv, and per scenario the figures
SCENARIO_bars.png (of three lambdas or more _curve.png, reward against computation), _timeline.png and _decisions.png;
settings.json and provenance.json say what they were made with. If stopped and started again with the same --out, it
resumes; with more controllers or scenarios, it adds them. `ms-highway report` makes a page of them."""

EXAMPLES = """\
examples:
  ms-highway compare
  ms-highway compare merger --controllers naive tom learned:1 switching:0.1 --seeds 10 --out results/merger
  ms-highway compare merger --controllers tom switching:{0.01,0.1} schedule:tom={4,6,8},naive --out results/curve
  ms-highway compare merger --ladder naive tom --controllers switching:0.1 --out results/two_rungs
  ms-highway compare give_way --semantics released --costs measured --out results/measured
  ms-highway compare stay_back --controllers naive turn --solver newton --seeds 100 --out results/newton
  ms-highway compare dense_merge --controllers naive tom nearest:1 budget:20 --out results/dense_merge
  ms-highway compare merger --yielding never --controllers tom tom+belief --out results/never
  ms-highway compare merger --horizon 10 --control-limit 0.2,9 --out results/second"""


YIELDING = ("usual", "never", "always", "mixed")
"""What the humans of environments may do beside the robot; told here so that help needs no JAX."""


def add_compare(commands: Any) -> None:
    """Add the command ``compare`` to a parser's subparsers."""
    parser = add_command(commands, "compare", "compare controllers over many episodes", HELP, EXAMPLES)
    add_scenarios(parser, known=[*SCENARIO_NAMES, *CROWD_NAMES])
    add_controllers(parser)
    parser.add_argument("--seeds", type=int, default=30, help="episodes per controller (default: 30)")
    parser.add_argument("--first-seed", dest="seed", type=int, default=0, help="of the first one (default: 0)")
    add_ladder(parser)
    add_semantics(parser)
    parser.add_argument(
        "--solver",
        choices=SOLVERS,
        help="how the robot improves its plans under naive and turn: gradient, the paper's 20 steps (default), or "
        "newton, second-order steps with a line search; tom always takes gradient steps. Among several humans, under "
        "all models: damped_newton (default), for horizons of seconds, or gradient",
    )
    add_costs(parser)
    add_planning(parser)
    add_humans(parser)
    parser.add_argument(
        "--yielding",
        choices=YIELDING,
        help="what humans do beside the robot: usual, plan for their reward (default); never yield, but keep their "
        "velocity; always make room for it; or mixed, each of them never or always, drawn for every episode",
    )
    parser.add_argument(
        "--no-way-out",
        dest="way_out",
        action="store_const",
        const=False,
        help=f"let plans leave no escape from humans who do not yield, in {', '.join(CROWD_NAMES)}",
    )
    add_out(parser, "results/compare")
    parser.set_defaults(run=_compare)


def comparison(options: argparse.Namespace) -> "Comparison":
    """Return the comparison that the options of ``ms-highway compare`` describe, checked.

    Raises:
        ValueError: naming what cannot be compared.
    """
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; there must be at least one episode")
    check_most(options, seeds=MOST)
    if options.seed < 0:
        raise ValueError(f"--first-seed is {options.seed}; it must not be negative")
    asked = asked_comparison(options, controllers_by_scenario(options), options.seeds)
    asked.check()
    return asked


def _compare(options: argparse.Namespace) -> None:
    from ms_highway.cli.results_directory import own_results
    from ms_highway.experiments.analysis.selection import select
    from ms_highway.experiments.analysis.summary import summary
    from ms_highway.experiments.results import read_results
    from ms_highway.experiments.runner import read, run
    from ms_highway.runtime.files import replacing
    from ms_highway.visualization.comparison import table
    from ms_highway.visualization.figures import CAPTIONS, figures

    asked = comparison(options)
    with own_results(options) as record:
        counts, wanted = run(asked, options.out), len(list(asked.episodes()))
        already = next(counts)
        if already < wanted:
            record()
        count_episodes(counts, already, wanted)
        summaries = summary(read(asked, options.out))
        for scenario in asked.controllers:
            print_tables(table(summaries, scenario))
        results = read_results(options.out)  # of this command and of those before
        with replacing(options.out / "summary.csv") as path:
            results.summaries.to_csv(path, index=False)
        for scenario in asked.controllers:
            selection = select(results.records, results.summaries, scenario)
            drawn = figures(results.records, results.summaries, scenario, selection)
            for name, figure in drawn.items():
                with replacing(options.out / f"{scenario}_{name}.png") as path:
                    figure.savefig(path, dpi=110)
            for name in CAPTIONS.keys() - drawn.keys():  # what fewer controllers had
                (options.out / f"{scenario}_{name}.png").unlink(missing_ok=True)
    print(f"results are in {options.out}")
