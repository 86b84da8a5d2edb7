"""Search for the best orders of models, and compute the regret of controllers.

The regret is by how much they fall short of the best orders. From a known start, an
episode is deterministic, so no rule for choosing models earns more than the best order
of models for this start. The order that a search finds is as good as that, or worse.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby, product
from pathlib import Path
from typing import ClassVar

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

BEST_PER_START = "best order of each start"
"""Name that `regrets` gives to the best orders that were found, one for each start."""


class Outcomes:
    """Episodes of one scenario, each of which is simulated once.

    Attributes:
        batch: the scenario.
        table: all known episodes by controller and seed: ``scenario``, ``reward``,
            ``counted_seconds``, ``collisions`` and ``fallbacks`` as in
            `ms_highway.experiments.comparison.per_episode`.
        index: columns that identify an episode.
        columns: the other columns, with functions that read a cell.
    """

    index: ClassVar[list[str]] = ["controller", "seed"]
    columns: ClassVar[dict[str, Callable[[str], str | float]]] = {
        "scenario": str,
        "reward": float,
        "counted_seconds": float,
        "collisions": int,
        "fallbacks": int,
    }

    def __init__(
        self,
        batch: Batch,
        file: Path,
        devices: Devices | None = None,
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
        no_episodes = pd.DataFrame(columns=[*self.index, *self.columns])
        self.table = no_episodes.set_index(self.index)
        if file.exists():
            with reading(file, "remove it or choose another directory"):
                self.table = self._read(file)

    def _read(self, file: Path) -> pd.DataFrame:
        """Read and check a table of episodes.

        Raises:
            ValueError: for episodes of another scenario, and for an episode that is
                there twice.
        """
        # Python's float restores exactly the numbers that were written.
        known = pd.read_csv(whole_lines(file), converters=self.columns)
        check_table(known)
        scenario = self.batch.environment.scenario.name
        others = {*known["scenario"]} - {scenario}
        if others:
            raise ValueError(
                f"it holds episodes of {min(others)!r}, not of {scenario!r}"
            )
        is_repeated = known.duplicated(self.index)
        repeated = known[self.index][is_repeated]
        if len(repeated):
            controller, seed = repeated.to_numpy().tolist()[0]
            raise ValueError(
                f"it holds the episode of {controller} with seed {seed} twice"
            )
        return known.set_index(self.index)[list(self.columns)]

    def of(self, keys: Sequence[Key]) -> pd.DataFrame:
        """Return the rows of episodes, in order; simulate and keep unknown ones."""
        different_keys = dict.fromkeys(keys)
        unknown = [key for key in different_keys if key not in self.table.index]
        if unknown:
            tables = self.batch.tables(unknown, self._devices)
            new = tables["episodes"].set_index(self.index)[list(self.columns)]
            self.table = pd.concat([self.table, new]) if len(self.table) else new
            write_table(self.table.reset_index(), self._file)
        return self.table.loc[list(keys)]


def controller_name(models: Sequence[str], order: Array) -> str:
    """Return the short name of an order, such as ``schedule:tom=6,naive`` or ``tom``.

    Args:
        models: names of the rungs.
        order: rung of all humans in each step.
    """
    names = [models[rung] for rung in order]
    stretches = []
    for name, steps in groupby(names):
        length = len(list(steps))
        stretches.append(f"{name}={length}")

    last = names[-1]
    if len(stretches) == 1:
        return last
    # The last model is kept until the end.
    parts = [*stretches[:-1], last]
    return f"schedule:{','.join(parts)}"


def search(
    outcomes: Outcomes,
    seeds: Sequence[int],
    prices: Sequence[float],
    population: int = 32,
    rounds: int = 8,
) -> Iterator[int]:
    """Search for the orders with the highest meta-reward, for each start and price.

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

    # Round 1: one rung after another one, with a change at one of at most 12 steps.
    spaced = np.round(np.geomspace(1, batch.steps, 12))
    steps_of_change = np.unique(spaced.astype(int))
    orders: dict[str, np.ndarray] = {}
    for change, first, second in product(steps_of_change, rungs, rungs):
        order = np.where(steps < change, first, second)
        name = controller_name(batch.rungs, order)
        orders[name] = order
    tried: dict[Key, None] = {(name, seed): None for seed in seeds for name in orders}

    # Further rounds: mutants of the best order of each start and price.
    for number in range(1, rounds + 1):
        rows = outcomes.of(list(tried))
        leaders = {price: best(rows, seeds, price)["controller"] for price in prices}
        for seed, price in product(seeds, prices):
            leader = leaders[price][seed]
            for _ in range(population):
                order = mutant(random, orders[leader], len(rungs))
                name = controller_name(batch.rungs, order)
                orders[name] = order
                tried[name, seed] = None
        yield number

    # Every start tries the best orders of the other starts.
    everywhere = sorted(set().union(*leaders.values()))
    outcomes.of(list(product(everywhere, seeds)))
    yield rounds + 1


def mutant(random: np.random.Generator, order: np.ndarray, rungs: int) -> np.ndarray:
    """Return an order [steps] with a random rung in one or two stretches of steps."""
    mean_length = 4
    new = order.copy()
    steps = len(order)
    for _ in range(random.integers(1, 3)):
        start = random.integers(steps)
        length = random.geometric(1 / mean_length)
        new[start : start + length] = random.integers(rungs)
    return new


def best(table: pd.DataFrame, seeds: Sequence[int], price: float) -> pd.DataFrame:
    """Return, by seed, the row with the highest meta-reward, and add that as a column.

    The meta-reward is ``r_R - lambda T(M)`` per step. The row may be that of any
    controller, as its choices are an order of models, too.

    Args:
        table: table of `Outcomes`.
        seeds: seeds of the starts.
        price: lambda [reward per second].
    """
    from_starts = table.query("seed in @seeds")
    rows = _with_meta_reward(from_starts, price).reset_index()
    best_rows = rows.groupby("seed")["meta_reward"].idxmax()
    return rows.loc[best_rows].set_index("seed")


def regrets(
    table: pd.DataFrame,
    controllers: Sequence[str],
    seeds: Sequence[int],
    price: float,
) -> pd.DataFrame:
    """Compute by how much controllers fall short of the best order of each start.

    Args:
        table: table of `Outcomes`.
        controllers: short names; their lambdas may differ from the price.
        seeds: seeds of the starts.
        price: lambda of the meta-reward [reward per second of planning].

    Returns:
        A row per ``controller``, with `BEST_PER_START` as the last: ``kind``; means
            over starts of ``reward`` and ``counted_seconds`` per step, of
            ``meta_reward`` and of ``regret``; and the 90 % interval of the mean regret,
            ``regret_low`` and ``regret_high`` (Student's t). There is also a row of the
            order with the highest mean meta-reward among those that were tried from
            every start.

    Raises:
        KeyError: if a controller was not driven from every start.
    """
    table = _with_meta_reward(table, price)
    best_rows = best(table, seeds, price)

    # The best order for all starts, among those that were tried from every start.
    by_start = table["meta_reward"].unstack("seed")[list(seeds)]
    means = by_start.dropna().mean(axis=1)
    kinds = means.index.map(lambda name: controller_config(name)["type"])
    means_of_orders = means[kinds.isin(fixed_order_types())]
    best_order = str(means_of_orders.idxmax())
    names = dict.fromkeys([*controllers, best_order])

    def row(name: str, kind: str, own: pd.DataFrame) -> dict:
        """Return the row of a controller, from its rows by seed."""
        regret = best_rows["meta_reward"] - own["meta_reward"]
        low, high = interval(regret)
        means = own[["reward", "counted_seconds", "meta_reward"]].mean()
        return {
            "controller": name,
            "kind": kind,
            **means,
            "regret": regret.mean(),
            "regret_low": low,
            "regret_high": high,
        }

    rows = []
    for name in names:
        keys = [(name, seed) for seed in seeds]
        own = table.loc[keys].droplevel("controller")
        kind = controller_config(name)["type"]
        rows.append(row(name, kind, own))
    rows.append(row(BEST_PER_START, "search", best_rows))
    return pd.DataFrame(rows)


def _with_meta_reward(table: pd.DataFrame, price: float) -> pd.DataFrame:
    """Return a table with the column ``meta_reward``, at a price."""
    return table.assign(meta_reward=table["reward"] - price * table["counted_seconds"])
