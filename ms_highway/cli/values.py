"""The command ``ms-highway values learn``."""

import argparse
from itertools import product
from math import ceil
from typing import TYPE_CHECKING, Any

from ms_highway.cli.command import command, number, option, output
from ms_highway.cli.console import say, telling
from ms_highway.cli.options import DEVICES, SCENARIOS, SET, configuration

if TYPE_CHECKING:
    from ms_highway.experiments.values.learning import Learning
    from ms_highway.experiments.values.rollouts import Course

SEVERAL: dict[str, Any] = {
    "prices": (30.0, 30.0),
    "rounds": 2,
    "states": (100, 100),
    "horizon": 25,
    "held": 25,
}
"""How values are learned among several humans, where that differs from the defaults of ``Learning``."""


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
    option(
        "--solvers",
        "of the robot's plans; each scenario is learned with each of them (default: gradient)",
        nargs="+",
        metavar="SOLVER",
    ),
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
    from ms_highway.experiments.values.learning import learn
    from ms_highway.loop.devices import use_devices

    learning, courses = _courses(options)
    values, kept = None, options.out.with_name(f"{options.out.name}.rollouts")
    with telling() as tell:
        tell(f"{courses[0].name}: compiling")
        for done, fitted in learn(learning, courses, kept, use_devices(options.devices)):
            tell(done)
            values = fitted or values
    if values is not None:
        save_values(values, options.out)
    rmtree(kept, ignore_errors=True)
    say(f"values are in {options.out}")


def _courses(options: argparse.Namespace) -> tuple["Learning", list["Course"]]:
    """Return what is to be learned, and where.

    Raises:
        ValueError: naming what cannot be learned.
    """
    from ms_highway.envs import PAPER_SCENARIOS
    from ms_highway.experiments.batch import make_batch
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.experiments.directory import this_run
    from ms_highway.experiments.values.learning import Learning
    from ms_highway.experiments.values.rollouts import Course
    from ms_highway.planning.human_models import cheapest_first, human_model

    config, scenarios = configuration(options), options.scenarios or PAPER_SCENARIOS
    solvers = [{"solver": solver} for solver in options.solvers or []]
    batches = {}
    for solver, scenario in product(solvers or [{}], scenarios):
        asked = Comparison({scenario: ["switching:1"]}, config={**config, **solver})  # which needs all T(M)
        batches[" ".join([scenario, *solver.values()])] = make_batch(asked, scenario)
    first, *others = every = list(batches.values())
    models = cheapest_first(name for batch in every for name in batch.rungs)
    costs = {name: seconds for batch in every for name, seconds in batch.costs.items()}
    several = first.humans > 1
    if any((batch.humans > 1) != several for batch in others):
        raise ValueError("some scenarios have one human, others several; learn them in a file each")
    if any(human_model(name).warm for name in models):
        raise ValueError("rollouts have no rest of a last plan to begin with; leave +warm out of the ladder")
    if first.loop.drivers:
        remedy = "leave config['yielding'] and config['human_driver'] out"
        raise ValueError(f"values are learned among humans who plan for their reward; {remedy}")
    courses = [
        Course(
            name,
            batch.loop,
            batch.environment.draw_episode,
            batch.steps,
            tuple(map(models.index, batch.rungs)),
        )
        for name, batch in batches.items()
    ]
    settings = {**first.comparison.common_config(), "versions": this_run()["versions"]}
    settings |= {"solver": options.solvers} if solvers else {}
    settings |= {"scenarios": list(scenarios), "seed": options.seed}
    settings["planning_horizon"] = first.environment.settings.horizon  # "horizon" is that of the rollouts
    later = options.states and (options.states if several else ceil(options.states * 5 / 8))
    given = {"rounds": options.rounds, "horizon": options.horizon, "states": later and (options.states, later)}
    own = (SEVERAL if several else {}) | {name: value for name, value in given.items() if value}
    learning = Learning({name: costs[name] for name in models}, seed=options.seed, settings=settings, **own)
    return learning, courses
