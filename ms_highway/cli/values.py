"""The command ``ms-highway values``: learn values of computation."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, telling
from ms_highway.cli.crowd_values import learn_crowd_values
from ms_highway.cli.options import SCENARIO_NAMES, add_devices, add_keys, add_number, configuration

if TYPE_CHECKING:
    from ms_highway.experiments.values.course import Course
    from ms_highway.experiments.values.learning import Learning

HELP = (
    "Learn when it pays to think: the value of planning with a more expensive model, for the controller learned:LAMBDA."
)

LEARN = """\
Learn the value of computation in some scenarios, for the controller learned:LAMBDA:FILE. From states that episodes
come through, every model of the ladder plans a step, and the rule that was learned so far chooses from there on;
networks are fitted to what was earned and planned, and so on for some rounds. One file serves all lambdas from 0.001
to 100.

Among several humans (dense_merge, crossing_crowd), every human has a value of its own: what the robot earns more with
this one human predicted by a dearer model. The file is for learned:LAMBDA:FILE there.

After every round, the regret per step is shown: how far the rule stays behind the best of simple orders of models from
starts that it was not learned on, a mean over prices of 0.1, 1 and 10. Starts are drawn anew, not by the numbered seeds
of environments: all of those are held out. The same --seed gives the same values. Rollouts are kept beside the file
until it is written: a run that was stopped or killed goes on when it is started again."""

LEARN_EXAMPLES = """\
examples:
  ms-highway values learn merger give_way --out values.npz
  ms-highway compare merger --controllers tom learned:1:values.npz
  ms-highway values learn dense_merge crossing_crowd --out crowd_values.npz
  ms-highway --import zipper values learn zipper --out zipper.npz"""

DEFAULTS = {"states": 400, "rounds": 5, "horizon_steps": 20}  # with one human


def add_values(commands: Any) -> None:
    """Add the command ``values`` with its subcommand to a parser's subparsers."""
    values = commands.add_parser("values", help="learn when it pays to think", description=HELP)
    subcommands = values.add_subparsers(title="commands", required=True, metavar="COMMAND")
    parser = add_command(subcommands, "learn", "learn values of computation", LEARN, LEARN_EXAMPLES)
    names = ", ".join(SCENARIO_NAMES)
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help=f"{names} (default: the paper's)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="of the values, such as values.npz")
    add_number(parser, "--generated", 0, "random scenes to be learned on as well", 0, 1000)
    states = "that rollouts start from in each scenario, in round 1; later ones have 5 for every 8 (default: 400; "
    add_number(parser, "--states", None, states + "among several humans 100 in every round)")
    add_number(parser, "--rounds", None, "of rollouts and fits (default: 5; among several humans 2)", most=100)
    steps = "of a rollout (default: 20; among several humans 25)"
    add_number(parser, "--horizon-steps", None, steps, most=100, metavar="STEPS")
    parser.add_argument(
        "--without",
        nargs="+",
        choices=("lambda", "gradients"),
        default=[],
        help="inputs that the networks do not get, to see what they are worth",
    )
    add_number(parser, "--seed", 0, "of everything that is drawn", 0)
    parser.add_argument(
        "--solvers",
        nargs="+",
        metavar="SOLVER",
        help="of the robot's plans; each scenario is learned with each of them (default: gradient)",
    )
    add_keys(parser)
    add_devices(parser)
    parser.set_defaults(run=_learn, simulates=True)


def _learn(options: argparse.Namespace) -> None:
    from ms_highway.envs import is_crowd
    from ms_highway.experiments.values.learning import learn, rollouts_file
    from ms_highway.metareasoning.values import save_values
    from ms_highway.simulation.devices import use_devices

    several = any(map(is_crowd, options.scenarios))
    if (options.horizon_steps or 1) > 20 and not several:
        raise ValueError(f"--horizon-steps is {options.horizon_steps}; with one human it must be 20 or less")
    if options.out.is_dir() or not options.out.parent.is_dir():
        raise ValueError(f"--out is {options.out}; name a file in a directory that exists, such as values.npz")
    if options.out.suffix != ".npz":
        raise ValueError(f"--out is {options.out}; give the file a name that ends in .npz")
    if several:
        learn_crowd_values(options)
        return
    for name, default in DEFAULTS.items():
        if getattr(options, name) is None:
            setattr(options, name, default)
    learning, courses = _courses(options)
    values, kept = None, rollouts_file(options.out)
    with telling() as tell:
        tell(f"{courses[0].name}: compiling")
        for done in learn(learning, courses, kept, use_devices(options.devices)):
            tell(f"round {done.round} of {options.rounds}: {done.course or 'fitted'}")
            if done.values is not None:
                values = done.values
                behind = ", ".join(f"{name} {regret:.3f}" for name, regret in done.regrets.items())
                print(f"round {done.round}: held-out regret per step: {behind or 'not measured'}", flush=True)
    if values is not None:
        save_values(values, options.out)
    kept.unlink(missing_ok=True)
    print(f"values are in {options.out}")


def _courses(options: argparse.Namespace) -> tuple["Learning", list["Course"]]:
    """Return what is to be learned, and where.

    Raises:
        ValueError: naming what cannot be learned.
    """
    from dataclasses import replace

    from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, two_player_scenario
    from ms_highway.envs.settings import Settings
    from ms_highway.experiments.comparison import Comparison
    from ms_highway.experiments.provenance import this_run
    from ms_highway.experiments.simulated import make_batch
    from ms_highway.experiments.values.course import Course
    from ms_highway.experiments.values.generator import generated_courses
    from ms_highway.experiments.values.learning import Learning
    from ms_highway.planning.effort import starts_warm
    from ms_highway.planning.human_models import human_model, known_models

    names = list(dict.fromkeys(options.scenarios or PAPER_SCENARIOS))
    for name in names:
        two_player_scenario(name)
    config = configuration(options)
    own = {key: config.pop(key) for key in ("semantics", "costs", "human_reward", "ladder") if key in config}
    first = Comparison({name: list(SCENARIOS[name].ladder[:1]) for name in names}, 1, planning=config, **own)
    solvers = list(dict.fromkeys(options.solvers or ["gradient"]))
    comparisons = [replace(first, solver=solver) for solver in solvers]
    for comparison in comparisons:
        comparison.check()
    batches = [make_batch(comparison, name) for comparison in comparisons for name in names]
    ladders = [[model.name for model in batch.environment.models] for batch in batches]
    models = known_models({name for ladder in ladders for name in ladder})
    models = [name for name in models if any(name in ladder for ladder in ladders)]
    if any(starts_warm(human_model(name)) for name in models):
        why = f"the ladder {' '.join(models)} plans from the rest of the last plan"
        raise ValueError(f"{why}, which rollouts do not have; leave +warm out of the ladder")
    costs = {name: seconds for batch in batches for name, seconds in batch.costs.items()}
    courses = [
        Course(
            batch.scenario.name if len(comparisons) == 1 else f"{batch.scenario.name} ({batch.comparison.solver})",
            batch.loop.game,
            batch.environment.draw_starts,
            batch.steps,
            tuple(models.index(model.name) for model in batch.environment.models),
        )
        for batch in batches
    ]
    settings = {**first.common_config(), "solver": solvers, "scenarios": names, "generated": options.generated}
    learning = Learning(
        {name: costs[name] for name in models},
        rounds=options.rounds,
        states=(options.states, -(-options.states * 5 // 8)),
        horizon=options.horizon_steps,
        without=tuple(options.without),
        seed=options.seed,
        settings={**settings, "seed": options.seed, "without": options.without, "versions": this_run("")["versions"]},
    )
    if options.generated:
        own_settings = Settings.read(first.config(names[0], models[0]))
        rungs, random = tuple(range(len(models))), learning.stream(0)
        share = min(1.0, 3 / options.generated) * 0.99
        courses += generated_courses(own_settings.game, rungs, options.generated, share, random)
    return learning, courses
