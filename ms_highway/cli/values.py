"""The command ``ms-highway values learn``."""

import argparse

from ms_highway.cli.command import command, number, output
from ms_highway.cli.console import say, tell
from ms_highway.cli.options import DEVICES, SCENARIOS, SET, configuration

STATES = (
    "that rollouts start from in each scenario, in round 1; later ones have 5 for every 8 (default: 400; among several "
    "humans 100 in every round)"
)


@command(
    "values learn",
    "learn values of computation: when it pays to think",
    SCENARIOS,
    output("--out", "of the values, such as values.npz", ".npz", required=True),
    number("--states", None, STATES),
    number("--rounds", None, "of rollouts and fits (default: 4; among several humans 2)", most=100),
    number(
        "--horizon-steps",
        None,
        "of a rollout (default: 20; among several humans 25)",
        most=100,
        metavar="STEPS",
        dest="horizon",
    ),
    number("--seed", 0, "of everything that is drawn", 0),
    SET,
    DEVICES,
    simulates=True,
)
def learn(options: argparse.Namespace) -> None:
    """Learn the value of computation in some scenarios, for the controller learned:LAMBDA:FILE. From states that
    episodes come through, a human is predicted by every model of the ladder for some steps, and then as the rule that
    was learned so far chooses; networks are fitted to what was earned more than by the cheapest model, and so on for
    some rounds. One file serves all lambdas and costs.

    Among several humans (dense-merge-v1, dense_merge, crossing_crowd), the nearest one, two, three and four are
    predicted by every model together; each has the value that it adds. The file is for learned:LAMBDA:FILE there.

    Starts are drawn anew, not by the numbered seeds of environments: all of those are held out, for `ms-highway
    frontier` to tell the regret of learned:LAMBDA:FILE. The same --seed gives the same values. Rollouts are kept beside
    the file until it is written: a run that was stopped or killed goes on when it is started again.

    Examples:
      ms-highway values learn merger give_way --out values.npz
      ms-highway compare merger --controllers tom learned:1:values.npz
      ms-highway values learn dense-merge-v1 --states 300 --out crowd.npz
      ms-highway --import zipper values learn zipper --out zipper.npz
    """
    from shutil import rmtree

    from ms_highway.choice.values import save_values
    from ms_highway.envs import PAPER_SCENARIOS
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.experiments.learning import learn, prepare
    from ms_highway.loop.devices import use_devices

    everywhere = {name: ["switching:1"] for name in options.scenarios or PAPER_SCENARIOS}
    asked = Comparison(everywhere, config=configuration(options))
    learning, courses = prepare(asked, options.rounds, options.states, options.horizon, options.seed)
    values, kept = None, options.out.with_name(f"{options.out.name}.rollouts")
    tell(f"{courses[0].name}: compiling")
    for done, fitted in learn(learning, courses, kept, use_devices(options.devices)):
        tell(done)
        values = fitted or values
    if values is not None:
        save_values(values, options.out)
    rmtree(kept, ignore_errors=True)
    say(f"values are in {options.out}")
