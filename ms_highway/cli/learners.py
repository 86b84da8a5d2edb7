"""The command ``ms-highway learners``."""

import argparse
from math import inf
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, print_tables, telling
from ms_highway.cli.frontier import LAMBDAS, drivers
from ms_highway.cli.options import (
    CONTROLLERS,
    MOST,
    add_costs,
    add_devices,
    add_ladder,
    add_out,
    add_planning,
    add_scenarios,
    add_semantics,
    asked_comparison,
    check_least,
    check_most,
)

if TYPE_CHECKING:
    from ms_highway.experiments.comparison import Comparison

__all__ = ["add_learners"]

HELP = """\
Train agents that choose the human model of every step, DQN of stable-baselines3, for --seconds and multiples of it, and
compare what they choose with every other way to choose, from the same starts: the fixed models, the most expensive one
at a fixed period, a random choice, the best order that all starts have in common, switching with its best lambda, and
the best order of each start, which is searched for as by `ms-highway frontier`. The agents' reward is the meta-reward:
the reward less --price times the seconds T(M) of planning. Needs the extra "learning".

An agent sees the states of all cars, scaled to about [-1, 1]. Its starts in training come from a stream of their own
(--training-seed) and are none of the numbered starts that it is judged by. --settings are the defaults of
stable-baselines3, or those of highway-env's quick start. How many steps of training fit into --seconds is measured
first; with --steps, the same agents are trained on the same machine again.

Results go to --out: learners.csv (a row per scenario and controller), what each agent chose (SCENARIO_DQN_....json),
SCENARIO_episodes.csv (all simulated episodes), settings.json and provenance.json. If stopped and started again with the
same --out, agents that were trained are not trained again."""

EXAMPLES = """\
examples:
  ms-highway learners merger give_way --price 1 --seconds 180
  ms-highway learners merger --steps 20000 --times 1 --settings highway-env --out results/quick_start"""

SETTINGS = ("default", "highway-env")
"""The names of `ms_highway.benchmarks.dqn_peer.SETTINGS`; told here so that help needs no JAX."""


def add_learners(commands: Any) -> None:
    """Add the command ``learners`` to a parser's subparsers."""
    parser = add_command(commands, "learners", "compare agents that learn to choose models", HELP, EXAMPLES)
    add_scenarios(parser)
    parser.add_argument("--price", type=float, default=1.0, help="lambda, reward for a second of planning (default: 1)")
    parser.add_argument("--seconds", type=float, default=180.0, help="of training (default: 180)")
    parser.add_argument("--steps", type=int, help="of training, instead of seconds")
    parser.add_argument(
        "--times", nargs="+", type=float, default=[1.0, 10.0], help="multiples of the training (default: 1 10)"
    )
    parser.add_argument(
        "--settings", nargs="+", choices=SETTINGS, default=[SETTINGS[0]], help="hyperparameters (default: default)"
    )
    parser.add_argument("--training-seed", type=int, default=0, metavar="SEED", help="of the training (default: 0)")
    parser.add_argument(
        "--controllers", nargs="+", default=[], metavar="CONTROLLER", help=f"others to compare with: {CONTROLLERS}"
    )
    parser.add_argument("--seeds", type=int, default=30, help="starts, seeded 0, 1, ... (default: 30)")
    parser.add_argument("--population", type=int, default=32, help="of the search for the best orders (default: 32)")
    parser.add_argument("--rounds", type=int, default=8, help="of the search for the best orders (default: 8)")
    add_ladder(parser)
    add_semantics(parser)
    add_costs(parser, measured=False)
    add_planning(parser)
    add_devices(parser)
    add_out(parser, "results/learners")
    parser.set_defaults(run=_learners, simulates=True)


def _learners(options: argparse.Namespace) -> None:
    import pandas as pd

    from ms_highway.benchmarks.dqn_peer import Training
    from ms_highway.benchmarks.learners import Budget, standings, train_all
    from ms_highway.benchmarks.processes import own_process
    from ms_highway.cli.results_directory import own_results
    from ms_highway.experiments.frontier import Outcomes, search
    from ms_highway.experiments.simulated import make_batch
    from ms_highway.runtime.files import replacing
    from ms_highway.runtime.jax_settings import low_latency
    from ms_highway.simulation.devices import use_devices
    from ms_highway.visualization.frontier import regret_table

    asked, mesh, seeds = _comparison(options), use_devices(options.devices), range(options.seeds)
    batches = {name: make_batch(asked, name) for name in asked.controllers}
    config = {**asked.common_config(), "costs": asked.costs}
    budget, table = Budget(options.seconds, options.steps, options.times), pd.DataFrame()
    with own_results(options, {**config, "price": options.price}) as record:
        record()
        with own_process(low_latency, options.modules) as process, telling() as tell:
            for scenario, batch in batches.items():
                trainings = [
                    Training(scenario, options.price, settings, options.training_seed, config)
                    for settings in options.settings
                ]
                agents = {}
                for name, agent in train_all(trainings, budget, seeds, options.out, process):
                    tell(f"{scenario}: training {name}")
                    if agent is not None:
                        agents[name] = agent
                outcomes = Outcomes(batch, options.out / f"{scenario}_episodes.csv", mesh)
                tell(f"{scenario}: searching for the best orders")
                for number in search(outcomes, seeds, [options.price], options.population, options.rounds):
                    tell(f"{scenario}: round {number} of {options.rounds + 1} of the search done")
                rungs = [model.name for model in batch.loop.rule.ladder]
                switching = [f"switching:{price:g}" for price in LAMBDAS]
                others = [name for name in asked.controllers[scenario] if name not in rungs]
                rows = standings(outcomes, agents, others, switching, seeds, options.price)
                table = pd.concat([table, rows.reset_index().assign(scenario=scenario)])
        with replacing(options.out / "learners.csv") as path:
            table.to_csv(path, index=False)
    for scenario, rows in table.groupby("scenario", sort=False):
        own = rows.set_index("controller")
        print_tables(regret_table(own, own["remark"].to_dict(), str(scenario), options.price))
    print(f"results are in {options.out}")


def _comparison(options: argparse.Namespace) -> "Comparison":
    """Return the fixed models and controllers that are driven, checked.

    Raises:
        ValueError: naming what cannot be compared.
    """
    from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, two_player_scenario
    from ms_highway.planning.human_models import rung_names

    check_least(options, seeds=1, population=1, rounds=1, devices=1, steps=1)
    check_most(options, seeds=MOST, population=MOST, rounds=MOST)
    for name, numbers in (("price", [options.price]), ("seconds", [options.seconds]), ("times", options.times)):
        for number in numbers:
            if not 0 <= number < inf or (number == 0 and name != "price"):
                raise ValueError(f"--{name} is {number:g}; it must be a positive number")
    if options.training_seed < 0:
        raise ValueError(f"--training-seed is {options.training_seed}; it must be 0 or more")
    for name in options.scenarios:
        two_player_scenario(name)
    others = drivers(options.controllers, [options.price], [options.price])
    controllers = {
        name: [*rung_names(options.ladder or SCENARIOS[name].ladder), *others]
        for name in options.scenarios or PAPER_SCENARIOS
    }
    asked = asked_comparison(options, controllers, options.seeds)
    asked.check()
    return asked
