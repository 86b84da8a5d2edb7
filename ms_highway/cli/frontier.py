"""The command ``ms-highway frontier``."""

import argparse
from collections.abc import Callable, Sequence
from math import inf
from typing import TYPE_CHECKING, Any

from ms_highway.cli.console import add_command, print_tables, telling
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
    import pandas as pd

    from ms_highway.experiments.comparison import Comparison
    from ms_highway.experiments.frontier import Outcomes

__all__ = ["LAMBDAS", "add_frontier", "drivers"]

HELP = """\
Search, for each start separately, for the order of human models with the highest meta-reward: the reward less
PRICE times the seconds T(M) of planning. The best possible choice of models earns at least that; the difference between
it and what a controller earns is the controller's regret. The models that switching chose in an episode are one of the
orders that are tried, and so are those of any other of --controllers.

The tables show the fixed models; the best of the orders that were tried from every start; other --controllers; and
switching, with the lambda that is the price, with the best of --lambdas for each scenario and with the best one for all
scenarios together; likewise other controllers that have a lambda. --prices are the lambdas of the meta-reward, which
judges; --lambdas are those that switching decides with. Whatever is best is chosen on the same starts that it is judged
by. Everything is simulated, and nothing timed. More than three prices take turns in the rounds of the search, so that
they cost little more.

Results go to --out: regrets.csv (a row per scenario, price and controller) and orders.csv (the best order of every
start), both of the last run; the figure SCENARIO_frontier.png (reward against computation); SCENARIO_episodes.csv (all
episodes); settings.json and provenance.json, which say what they were made with. Episodes are kept after every round:
if stopped or killed and started again with the same --out, the search resumes, and with more seeds, prices, lambdas or
rounds it uses what is there. Results are the same on any number of devices."""

EXAMPLES = """\
examples:
  ms-highway frontier
  ms-highway frontier merger --seeds 10 --prices 0.3 3 --out results/merger_frontier
  ms-highway frontier --prices 0.001 0.003 0.01 0.03 0.1 0.3 1 3 10 --rounds 16 --out results/wide
  ms-highway frontier merger --controllers period:tom=1,naive=3 random:naive=0.7,tom=0.3 --out results/blind"""

ESTIMATES = "switching", "horizon"  # of the paper; they may decide best with another lambda than the price
LAMBDAS = [0.0, 0.0001, 0.0003, 0.001, 0.003, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2, 0.3, 0.6, 1.0, 3.0, 10.0]


def add_frontier(commands: Any) -> None:
    """Add the command ``frontier`` to a parser's subparsers."""
    parser = add_command(commands, "frontier", "search for the best orders of models", HELP, EXAMPLES)
    add_scenarios(parser)
    parser.add_argument(
        "--meta-prices",
        "--prices",
        dest="prices",
        nargs="+",
        type=float,
        default=[0.1, 1.0, 10.0],
        metavar="PRICE",
        help="lambda of the meta-reward that orders are searched for and controllers judged by: reward for a second of "
        "planning (default: 0.1 1 10)",
    )
    parser.add_argument(
        "--lambdas",
        nargs="+",
        type=float,
        default=LAMBDAS,
        metavar="LAMBDA",
        help="lambda that switching decides with, which need not be the price (default: 16 from 0 to 10)",
    )
    parser.add_argument(
        "--controllers",
        nargs="+",
        default=[],
        metavar="CONTROLLER",
        help=f"controllers beside the ladder's models and switching: {CONTROLLERS}; a kind that has a lambda, without "
        "it, stands for one controller at each of --prices, or for the paper's estimates at each of --lambdas",
    )
    parser.add_argument("--seeds", type=int, default=30, help="starts, seeded 0, 1, ... (default: 30)")
    parser.add_argument("--population", type=int, default=32, help="orders per start, price and round (default: 32)")
    parser.add_argument(
        "--rounds", type=int, default=8, help="of the search (default: 8), before starts try each other's best orders"
    )
    add_ladder(parser)
    add_semantics(parser)
    add_costs(parser, measured=False)
    add_planning(parser)
    add_devices(parser)
    add_out(parser, "results/frontier")
    parser.set_defaults(run=_frontier, simulates=True)


def _frontier(options: argparse.Namespace) -> None:
    from ms_highway.cli.results_directory import own_results
    from ms_highway.experiments.frontier import Outcomes
    from ms_highway.experiments.simulated import make_batch
    from ms_highway.simulation.devices import use_devices
    from ms_highway.visualization.frontier import regret_tables

    asked = _comparison(options)
    mesh = use_devices(options.devices)
    batches = {name: make_batch(asked, name) for name in asked.controllers}
    with own_results(options, {**asked.common_config(), "costs": asked.costs}) as record:
        every = [Outcomes(batch, options.out / f"{name}_episodes.csv", mesh) for name, batch in batches.items()]
        record()
        with telling() as tell:
            regrets = _search(every, options, tell)
    for scenario in asked.controllers:
        print_tables(*regret_tables(regrets, scenario))
    print(f"results are in {options.out}")


def _comparison(options: argparse.Namespace) -> "Comparison":
    """Return the fixed models and controllers that are driven in any case, checked.

    Raises:
        ValueError: naming what cannot be searched.
    """
    from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS, two_player_scenario
    from ms_highway.planning.human_models import rung_names

    check_least(options, seeds=1, population=1, rounds=1, devices=1)
    check_most(options, seeds=MOST, population=MOST, rounds=MOST)
    if options.seeds * options.population > MOST:
        product = f"--seeds {options.seeds} times --population {options.population}"
        orders = options.seeds * options.population
        raise ValueError(f"{product} is {orders} orders in a round; it must be {MOST} or less")
    for price in options.prices:
        if not 0 <= price < inf:
            raise ValueError(f"--prices has {price:g}; a price must be a number that is not negative, such as 0.1")
    for name in options.scenarios:
        two_player_scenario(name)
    driven = drivers([*options.controllers, "switching"], options.prices, options.lambdas)
    controllers = {
        name: [*rung_names(options.ladder or SCENARIOS[name].ladder), *driven]
        for name in options.scenarios or PAPER_SCENARIOS
    }
    asked = asked_comparison(options, controllers, options.seeds)
    asked.check()
    return asked


def drivers(names: Sequence[str], prices: Sequence[float], lambdas: Sequence[float]) -> list[str]:
    """Return short names of controllers; the name of a kind that has a lambda stands for one at each of several.

    Args:
        names: of controllers, or of kinds that have a lambda.
        prices: lambdas of kinds that are told the price.
        lambdas: of the paper's estimates.
    """
    from ms_highway.envs.controllers import CHOOSING

    kinds = {kind: lambdas if kind in ESTIMATES else prices for kind in CHOOSING}
    return [
        driver
        for name in names
        for driver in ([f"{name}:{price:g}" for price in kinds[name]] if name in kinds else [name])
    ]


def _search(every: Sequence["Outcomes"], options: argparse.Namespace, tell: Callable[[str], None]) -> "pd.DataFrame":
    """Search in one scenario after the other, and write its results once it is done; return the regrets in all."""
    import pandas as pd

    from ms_highway.experiments.analysis.regret import best, regrets
    from ms_highway.experiments.frontier import search
    from ms_highway.runtime.files import replacing
    from ms_highway.visualization.frontier import figure

    orders, behind = pd.DataFrame(), pd.DataFrame()
    for outcomes in every:
        batch = outcomes.batch
        scenario, seeds = batch.scenario.name, range(options.seeds)
        controllers = batch.comparison.controllers[scenario]
        tell(f"{scenario}: compiling, and driving fixed models and controllers")
        outcomes.of(batch.keys())
        for number in search(outcomes, seeds, options.prices, options.population, options.rounds):
            tell(f"{scenario}: round {number} of {options.rounds + 1} done, {len(outcomes.table)} episodes")
        for price in dict.fromkeys(options.prices):
            place = {"scenario": scenario, "price": price}
            found = best(outcomes.table, seeds, price).reset_index().assign(**place)
            own = regrets(outcomes.table, controllers, seeds, price).reset_index().assign(**place)
            orders, behind = pd.concat([orders, found]), pd.concat([behind, own])
        for name, table in (("orders", orders), ("regrets", behind)):
            with replacing(options.out / f"{name}.csv") as path:
                table.to_csv(path, index=False)
        with replacing(options.out / f"{scenario}_frontier.png") as path:
            figure(outcomes.table, behind, scenario, seeds).savefig(path, dpi=110)
    return behind
