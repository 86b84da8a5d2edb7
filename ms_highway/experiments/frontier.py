"""Search for the best orders of models, and compute the regret of controllers, by which
they fall short of these.

From a known start, an episode is deterministic, so no rule for choosing models earns
more than the best order of models for this start. The order that a search finds is as
good as that, or worse.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby, product
from pathlib import Path

import numpy as np
import pandas as pd

from ms_highway.envs.registry import controller_config, fixed_order_types
from ms_highway.experiments.batch import Batch, Key
from ms_highway.experiments.comparison import check_table
from ms_highway.experiments.directory import write_table
from ms_highway.experiments.summary import interval
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import Devices
from ms_highway.runtime.files import reading, whole_lines

MEAN_STRETCH = 4  # mean number of steps in a stretch that a mutant changes
SWITCHES = 12  # number of steps at which the first orders may change their rung
INDEX = ["controller", "seed"]
KEPT_COLUMNS = {
    "scenario": str,
    "reward": float,
    "counted_seconds": float,
    "collisions": int,
    "fallbacks": int,
}

BEST_PER_START = "best order of each start"
"""Name that `regrets` gives to the best orders that were found, one for each start."""


class Outcomes:
    """Episodes of one scenario, each of which is simulated once.

    Attributes:
        batch: the scenario.
        table: all known episodes by controller and seed: ``scenario``, ``reward``,
            ``counted_seconds``, ``collisions`` and ``fallbacks`` as in
            `ms_highway.experiments.comparison.per_episode`.
    """

    def __init__(
        self, batch: Batch, file: Path, devices: Devices | None = None
    ) -> None:
        """Begin with the episodes in a file.

        Args:
            batch: the scenario.
            file: CSV file that keeps all episodes.
            devices: see `ms_highway.loop.batch.simulate`.

        Raises:
            ValueError: if the file exists and holds something else.
        """
        self.batch = batch
        self._file = file
        self._devices = devices
        self.table = pd.DataFrame(columns=[*INDEX, *KEPT_COLUMNS]).set_index(INDEX)
        if file.exists():
            with reading(file, "remove it or choose another directory"):
                # Python's float restores exactly the numbers that were written.
                known = pd.read_csv(whole_lines(file), converters=KEPT_COLUMNS)
                check_table(known)
                own = batch.environment.scenario.name
                if other := {*known["scenario"]} - {own}:
                    raise ValueError(
                        f"it holds episodes of {min(other)!r}, not of {own!r}"
                    )
                if twice := known[INDEX][known.duplicated(INDEX)].to_numpy().tolist():
                    controller, seed = twice[0]
                    raise ValueError(
                        f"it holds the episode of {controller} with seed {seed} twice"
                    )
                self.table = known.set_index(INDEX)[list(KEPT_COLUMNS)]

    def of(self, keys: Sequence[Key]) -> pd.DataFrame:
        """Return the rows of some episodes, in their order; simulate and keep the
        unknown ones.
        """
        lacking = [key for key in dict.fromkeys(keys) if key not in self.table.index]
        if lacking:
            episodes = self.batch.tables(lacking, self._devices)["episodes"]
            fresh = episodes.set_index(INDEX)[list(KEPT_COLUMNS)]
            self.table = pd.concat([self.table, fresh]) if len(self.table) else fresh
            write_table(self.table.reset_index(), self._file)
        return self.table.loc[list(keys)]


def controller_name(models: Sequence[str], order: Array) -> str:
    """Return the short name of an order as a controller, such as
    ``schedule:tom=6,naive`` or ``tom``.

    Args:
        models: names of the rungs.
        order: rung of all humans in each step.
    """
    names = [models[rung] for rung in order]
    *stretches, (last, _) = [(name, len(list(steps))) for name, steps in groupby(names)]
    if not stretches:
        return last
    return "schedule:" + ",".join(
        [*(f"{name}={steps}" for name, steps in stretches), last]
    )


def search(
    outcomes: Outcomes,
    seeds: Sequence[int],
    prices: Sequence[float],
    population: int = 32,
    rounds: int = 8,
) -> Iterator[int]:
    """Search for the orders of models with the highest meta-reward, for each start and
    price separately.

    This is an evolution strategy. Round 1 tries, from every start, the same orders that
    change the rung at most once. Each further round tries mutants of the best order so
    far, see `mutant`. An order that was tried for one price counts for all prices.
    After the last round, every start tries the best orders of the other starts.

    The same arguments give the same orders on any number of devices, even if a search
    was interrupted and resumed.

    Args:
        outcomes: episodes of the scenario.
        seeds: seeds of the starts.
        prices: lambdas [reward per second].
        population: number of orders per start, price and round.
        rounds: number of rounds.

    Yields:
        The number of each finished round, from 1; a last number after the starts have
        tried each other's best orders.
    """
    random = np.random.default_rng(0)
    batch = outcomes.batch
    rungs = range(len(batch.rungs))
    steps = np.arange(batch.steps)
    ends = np.unique(np.round(np.geomspace(1, batch.steps, SWITCHES)).astype(int))
    drawn = [
        np.where(steps < end, *pair) for end in ends for pair in product(rungs, rungs)
    ]
    orders = {controller_name(batch.rungs, order): order for order in drawn}
    tried = {(name, seed): None for seed in seeds for name in orders}
    for number in range(1, rounds + 1):
        rows = outcomes.of(list(tried))
        leaders = {price: best(rows, seeds, price)["controller"] for price in prices}
        for seed, price in product(seeds, prices):
            for _ in range(population):
                order = mutant(random, orders[leaders[price][seed]], len(rungs))
                name = controller_name(batch.rungs, order)
                orders[name] = order
                tried[name, seed] = None
        yield number
    everywhere = sorted(set().union(*leaders.values()))
    outcomes.of(list(product(everywhere, seeds)))
    yield rounds + 1


def mutant(random: np.random.Generator, order: np.ndarray, rungs: int) -> np.ndarray:
    """Return an order [steps] with a random rung in one or two stretches of steps."""
    new = order.copy()
    steps = len(order)
    for _ in range(random.integers(1, 3)):
        start = random.integers(steps)
        length = random.geometric(1 / MEAN_STRETCH)
        new[start : start + length] = random.integers(rungs)
    return new


def best(table: pd.DataFrame, seeds: Sequence[int], price: float) -> pd.DataFrame:
    """Return, by seed, the row with the highest meta-reward, ``r_R - lambda T(M)`` per
    step, and add it as a column.

    The row may be that of any controller, as its choices are an order of models, too.

    Args:
        table: table of `Outcomes`.
        seeds: seeds of the starts.
        price: lambda [reward per second].
    """
    rows = _judged(table.query("seed in @seeds"), price).reset_index()
    return rows.loc[rows.groupby("seed")["meta_reward"].idxmax()].set_index("seed")


def regrets(
    table: pd.DataFrame, controllers: Sequence[str], seeds: Sequence[int], price: float
) -> pd.DataFrame:
    """Compute by how much controllers fall short of the best order that was found for
    each start.

    Args:
        table: table of `Outcomes`.
        controllers: short names; their lambdas may differ from the price.
        seeds: seeds of the starts.
        price: lambda of the meta-reward [reward per second of planning].

    Returns:
        A row per ``controller``, with `BEST_PER_START` as the last: ``kind``; means
            over starts of ``reward`` and
        ``counted_seconds`` per step, of ``meta_reward`` and of ``regret``; and the 90 %
        interval of the mean regret, ``regret_low`` and ``regret_high`` (Student's t).
        There is also a row of the order with the highest mean meta-reward among those
        that were tried from every start.

    Raises:
        KeyError: if a controller was not driven from every start.
    """
    table = _judged(table, price)
    found = best(table, seeds, price)
    everywhere = table["meta_reward"].unstack("seed")[list(seeds)].dropna().mean(axis=1)
    kinds = everywhere.index.map(lambda name: controller_config(name)["type"])
    names = dict.fromkeys(
        [*controllers, str(everywhere[kinds.isin(fixed_order_types())].idxmax())]
    )
    driven = {
        name: table.loc[[(name, seed) for seed in seeds]].droplevel("controller")
        for name in names
    }
    rows = []
    for name, own in {**driven, BEST_PER_START: found}.items():
        behind = found["meta_reward"] - own["meta_reward"]
        low, high = interval(behind)
        row = {
            "controller": name,
            "kind": "search" if own is found else controller_config(name)["type"],
        }
        row |= own[["reward", "counted_seconds", "meta_reward"]].mean()
        rows.append(
            row | {"regret": behind.mean(), "regret_low": low, "regret_high": high}
        )
    return pd.DataFrame(rows)


def _judged(table: pd.DataFrame, price: float) -> pd.DataFrame:
    """Return a table with the column ``meta_reward``, at a price."""
    return table.assign(meta_reward=table["reward"] - price * table["counted_seconds"])
