"""The command ``ms-highway values learn``."""

import argparse
from typing import TYPE_CHECKING, Any

from ms_highway.cli.command import command, number, option, output
from ms_highway.cli.console import say, telling
from ms_highway.cli.options import DEVICES, SCENARIOS, SET, configuration

if TYPE_CHECKING:
    from ms_highway.experiments.values.learning import Learning
    from ms_highway.experiments.values.rollouts import Course

DECIDED = 0.4  # of an episode among several humans, in which it is decided whether the robot merges
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
    output("--out", "of the values, such as values.npz", required=True),
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

    Among several humans (dense_merge, crossing_crowd), every human has a value of its own. The file is for
    learned:LAMBDA:FILE there.

    After every round, the regret per step is shown: how far the rule stays behind the best of simple orders of models
    from starts that it was not learned on, a mean over prices of 0.1, 1 and 10. Starts are drawn anew, not by the
    numbered seeds of environments: all of those are held out. The same --seed gives the same values. Rollouts are kept
    beside the file until it is written: a run that was stopped or killed goes on when it is started again.

    Examples:
      ms-highway values learn merger give_way --out values.npz
      ms-highway compare merger --controllers tom learned:1:values.npz
      ms-highway values learn dense_merge crossing_crowd --out several.npz
      ms-highway --import zipper values learn zipper --out zipper.npz
    """
    from shutil import rmtree

    from ms_highway.choice.values import save_values
    from ms_highway.experiments.values.learning import learn, rollouts_directory
    from ms_highway.loop.devices import use_devices

    if options.out.suffix != ".npz":
        raise ValueError(f"--out is {options.out}; give the file a name that ends in .npz")
    learning, courses = _courses(options)
    values, kept = None, rollouts_directory(options.out)
    with telling() as tell:
        tell(f"{courses[0].name}: compiling")
        for done in learn(learning, courses, kept, use_devices(options.devices)):
            tell(f"round {done.round} of {learning.rounds}: {done.course or 'fitted'}")
            values = done.values or values
            if done.regrets:
                behind = ", ".join(f"{name} {regret:.3f}" for name, regret in done.regrets.items())
                say(f"round {done.round}: held-out regret per step: {behind}")
    if values is not None:
        save_values(values, options.out)
    rmtree(kept, ignore_errors=True)
    say(f"values are in {options.out}")


def _courses(options: argparse.Namespace) -> tuple["Learning", list["Course"]]:
    """Return what is to be learned, and where.

    Raises:
        ValueError: naming what cannot be learned.
    """
    from ms_highway.choice.rule import SHIPPED_COSTS
    from ms_highway.envs import ENVIRONMENTS, PAPER_SCENARIOS, environment_id
    from ms_highway.experiments.batch import make_batch
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.experiments.directory import this_run
    from ms_highway.experiments.values.learning import Learning
    from ms_highway.experiments.values.rollouts import Course
    from ms_highway.planning.human_models import cheapest_first, human_model

    names, config = list(dict.fromkeys(options.scenarios or PAPER_SCENARIOS)), configuration(options)
    for name in names:
        environment_id(name)
    alone = [name for name in names if not ENVIRONMENTS[name].scenario.streams]
    if 0 < len(alone) < len(names):
        raise ValueError(f"{alone[0]} has one human, other scenarios several; learn them in a file each")
    if not alone:
        given = config.get("costs", {})
        config["costs"] = given if isinstance(given, str) else {**SHIPPED_COSTS, **given}
    solvers = [{"solver": solver} for solver in dict.fromkeys(options.solvers or [])]
    batches = [
        make_batch(Comparison({name: ENVIRONMENTS[name].scenario.ladder[:1]}, 1, config={**config, **solver}), name)
        for solver in solvers or [{}]
        for name in names
    ]
    models = cheapest_first(name for batch in batches for name in batch.rungs)
    if any(human_model(name).warm for name in models):
        why = f"the ladder {' '.join(models)} plans from the rest of the last plan"
        raise ValueError(f"{why}, which rollouts do not have; leave +warm out of the ladder")
    if any(batch.loop.yielding for batch in batches):
        raise ValueError("values are learned among humans who plan for their reward; leave config['yielding'] out")
    costs = {name: seconds for batch in batches for name, seconds in batch.costs.items()}
    courses = [
        Course(
            batch.scenario if len(solvers) < 2 else f"{batch.scenario} ({batch.comparison.config['solver']})",
            batch.loop,
            batch.environment.draw_episode,
            batch.steps if alone else round(DECIDED * batch.steps),
            tuple(map(models.index, batch.rungs)),
        )
        for batch in batches
    ]
    settings = {
        **batches[0].comparison.common_config(),
        "versions": this_run()["versions"],
        **({"solver": [each["solver"] for each in solvers]} if solvers else {}),
        "scenarios": names,
        "seed": options.seed,
    }
    own = {} if alone else dict(SEVERAL)
    own |= {name: getattr(options, name) for name in ("rounds", "horizon") if getattr(options, name)}
    if options.states:
        own["states"] = options.states, -(-options.states * 5 // 8) if alone else options.states
    learning = Learning({name: costs[name] for name in models}, seed=options.seed, settings=settings, **own)
    return learning, courses
