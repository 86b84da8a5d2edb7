"""The command ``ms-highway frontier``."""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ms_highway.cli.console import add_command, print_tables, work
from ms_highway.cli.options import (
    MOST,
    add_costs,
    add_devices,
    add_planning,
    add_semantics,
    check_least,
    check_most,
    costs,
    human_reward,
    note_run,
    planning,
)
from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, environment_id
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.frontier import Outcomes, search
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.regret import best, regrets
from ms_highway.experiments.settings import SETTINGS_FILE, check_settings
from ms_highway.experiments.simulated import Batch, make_batch
from ms_highway.runtime.files import held, replacing, tidy
from ms_highway.runtime.jax_settings import high_throughput
from ms_highway.simulation.devices import use_devices
from ms_highway.visualization.frontier import figure, regret_tables

__all__ = ["add_frontier"]

HELP = """\
Search, for every start by itself, for the order of human models with the highest meta-reward: reward less the price of
planning, for every second T(M). The best possible choice of models has at least that; how far a controller stays behind
it is its regret. What switching chose in an episode is one of the orders that were tried.

Told are the fixed models; the best order of those that were tried from every start; and switching, with the best of
--lambdas for each scenario and with the best one for all scenarios together. That lambda need not be the price. All
that is best was chosen by these very starts. Everything is simulated, and nothing timed.

Results go to --out: regrets.csv (a row per scenario, price and controller) and orders.csv (the best order of every
start), both of the last run; the figure SCENARIO_frontier.png (reward against computation); SCENARIO_episodes.csv (all
episodes); settings.json and provenance.json, which say what they were made with. Episodes are kept after every round:
stopped or killed and started again with the same --out, the search goes on where it was, and with more seeds, prices,
lambdas or rounds it uses what is there. Results are the same on any number of devices."""

EXAMPLES = """\
examples:
  ms-highway frontier
  ms-highway frontier merger --seeds 10 --prices 0.3 3 --out results/merger_frontier"""

LAMBDAS = [0.0, 0.0001, 0.0003, 0.001, 0.003, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.6, 1.0, 3.0, 10.0]


def add_frontier(commands: Any) -> None:
    """Add the command ``frontier`` to a parser's subparsers."""
    parser = add_command(commands, "frontier", "search for the best orders of models", HELP, EXAMPLES)
    parser.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO", help=f"{', '.join(SCENARIOS)} (default: the paper's)"
    )
    parser.add_argument(
        "--prices",
        nargs="+",
        type=float,
        default=[0.1, 1.0, 10.0],
        help="reward for a second of planning (default: 0.1 1 10)",
    )
    parser.add_argument(
        "--lambdas", nargs="+", type=float, default=LAMBDAS, help="of switching (default: 16 from 0 to 10)"
    )
    parser.add_argument("--seeds", type=int, default=30, help="starts, seeded 0, 1, ... (default: 30)")
    parser.add_argument("--population", type=int, default=32, help="orders per start, price and round (default: 32)")
    parser.add_argument(
        "--rounds", type=int, default=8, help="of the search (default: 8), before starts try each other's best orders"
    )
    parser.add_argument("--ladder", nargs="+", metavar="MODEL", help="models to choose from (default: the scenario's)")
    add_semantics(parser)
    add_costs(parser, measured=False)
    add_planning(parser)
    add_devices(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        default=Path("results/frontier"),
        help="directory of results (default: results/frontier)",
    )
    parser.set_defaults(run=_frontier, prepare=high_throughput)


def _frontier(options: argparse.Namespace) -> None:
    comparison = _comparison(options)
    mesh = use_devices(options.devices)
    batches = [make_batch(comparison, name) for name in comparison.controllers]
    settings = {**comparison.common_config(), "costs": comparison.costs}
    check_settings(options.out, settings)
    with held(options.out):
        tidy(options.out)
        read_runs(options.out)  # refuses what cannot be read before anything is run
        every = [Outcomes(batch, _file(options.out, batch), mesh) for batch in batches]
        with replacing(options.out / SETTINGS_FILE) as path:
            path.write_text(json.dumps(settings, indent=2) + "\n")
        note_run(options)
        behind = work(_search(every, options))
    for scenario in comparison.controllers:
        print_tables(*regret_tables(behind, scenario))
    print(f"results are in {options.out}")


def _comparison(options: argparse.Namespace) -> Comparison:
    """What is to be driven anyway, checked.

    Raises:
        ValueError: naming what cannot be searched.
    """
    check_least(options, seeds=1, population=1, rounds=1, devices=1)
    check_most(options, seeds=MOST, population=MOST, rounds=MOST)
    if options.seeds * options.population > MOST:
        told = f"--seeds {options.seeds} times --population {options.population}"
        raise ValueError(f"{told} is {options.seeds * options.population} orders in a round; it must be {MOST} or less")
    for price in options.prices:
        if not 0 <= price < np.inf:
            raise ValueError(f"--prices has {price:g}; a price must be a number that is not negative, such as 0.1")
    for name in options.scenarios:
        environment_id(name)
    controllers = {
        name: [*(options.ladder or SCENARIOS[name].ladder), *(f"switching:{one:g}" for one in options.lambdas)]
        for name in options.scenarios or PAPER_SCENARIOS
    }
    comparison = Comparison(
        {name: list(dict.fromkeys(some)) for name, some in controllers.items()},
        options.seeds,
        options.semantics,
        costs(options.costs),
        human_reward=human_reward(options.human_reward),
        ladder=options.ladder,
        planning=planning(options),
    )
    comparison.check()
    return comparison


def _file(directory: Path, batch: Batch) -> Path:
    return directory / f"{batch.scenario.name}_episodes.csv"


def _search(every: Sequence[Outcomes], options: argparse.Namespace) -> Iterator[str | pd.DataFrame]:
    """Says what it is doing, writes the results of every scenario that is done, and yields all regrets."""
    orders, behind = pd.DataFrame(), pd.DataFrame()
    for outcomes in every:
        batch = outcomes.batch
        scenario, seeds = batch.scenario.name, range(options.seeds)
        controllers = batch.comparison.controllers[scenario]
        yield f"{scenario}: compiling, and driving fixed models and switching"
        outcomes.of(batch.keys())
        for number in search(outcomes, seeds, options.prices, options.population, options.rounds):
            yield f"{scenario}: round {number} of {options.rounds + 1} done, {len(outcomes.table)} episodes"
        for price in dict.fromkeys(options.prices):
            told = {"scenario": scenario, "price": price}
            found = best(outcomes.table, seeds, price).reset_index().assign(**told)
            own = regrets(outcomes.table, controllers, seeds, price).reset_index().assign(**told)
            orders, behind = pd.concat([orders, found]), pd.concat([behind, own])
        for name, table in (("orders", orders), ("regrets", behind)):
            with replacing(options.out / f"{name}.csv") as path:
                table.to_csv(path, index=False)
        with replacing(options.out / f"{scenario}_frontier.png") as path:
            figure(outcomes.table, behind, scenario, seeds).savefig(path, dpi=110)
    yield behind
