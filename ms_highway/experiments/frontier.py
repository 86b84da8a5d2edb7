"""The best orders of models, found by search, and regret: how far controllers stay behind them.

From a known start nothing in an episode is left to chance, so that no rule for choosing models, however clever, earns
more than the best order of models for that very start. What a search finds is as good as that, or worse.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby, product
from pathlib import Path

import numpy as np
import pandas as pd
from jax.sharding import Mesh

from ms_highway.envs.registry import controller_config, fixed_order_types
from ms_highway.experiments.batch import Batch, Key
from ms_highway.experiments.directory import write_table
from ms_highway.experiments.records import check_table
from ms_highway.experiments.summary import interval
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.files import reading

MEAN_STRETCH = 4  # steps, mean of their number in a stretch that is changed
SINGLE_SHARE = 0.5  # of the changes among several humans: for a single one
SWITCHES = 12  # steps at which the first orders go over from one rung to another
INDEX = ["controller", "seed"]
KEPT_COLUMNS = {"scenario": str, "reward": float, "counted_seconds": float, "collisions": int, "fallbacks": int}

BEST_PER_START = "best order of each start"
"""Name that `regrets` gives to the best order that was found for every start."""


class Outcomes:
    """Episodes of one scenario, each of which is simulated once.

    Attributes:
        batch: the scenario.
        table: what is known, by controller and seed: ``scenario``, ``reward``, ``counted_seconds``, ``collisions`` and
            ``fallbacks`` as in `ms_highway.experiments.records.per_episode`.
    """

    def __init__(self, batch: Batch, file: Path, mesh: Mesh | None = None) -> None:
        """Begin with what a file knows.

        Args:
            batch: the scenario.
            file: where all outcomes are kept, as CSV.
            mesh: devices, see `ms_highway.loop.devices.device_mesh`.

        Raises:
            ValueError: if the file is there and holds something else.
        """
        self.batch, self._file, self._mesh = batch, file, mesh
        self.table = pd.DataFrame(columns=[*INDEX, *KEPT_COLUMNS]).set_index(INDEX)
        if file.exists():
            with reading(file, "remove it or choose another directory"):
                # Python's float gives back the very numbers that were written.
                known = pd.read_csv(file, converters=KEPT_COLUMNS)
                check_table(known)
                self.table = known.set_index(INDEX)[list(KEPT_COLUMNS)]

    def of(self, keys: Sequence[Key]) -> pd.DataFrame:
        """Return the rows of some episodes, in their order; simulate and keep those that are not known."""
        lacking = [key for key in dict.fromkeys(keys) if key not in self.table.index]
        if lacking:
            episodes = self.batch.tables(lacking, self.batch.simulate(lacking, self._mesh))["episodes"]
            fresh = episodes.set_index(INDEX)[list(KEPT_COLUMNS)]
            self.table = pd.concat([self.table, fresh]) if len(self.table) else fresh
            write_table(self.table.reset_index(), self._file)
        return self.table.loc[list(keys)]


def controller_name(models: Sequence[str], order: Array) -> str:
    """Return the short name of the controller that plans with these models: ``schedule:tom=6,naive``, ``tom``.

    Models that differ between humans are named one by one: ``schedule:tom/naive=6,naive``.

    Args:
        models: names of the rungs.
        order: the rung of every human in each step, [steps, humans].
    """
    names = ["/".join(models[rung] for rung in (rungs if len(set(rungs)) > 1 else rungs[:1])) for rungs in order]
    *stretches, (last, _) = [(name, len(list(steps))) for name, steps in groupby(names)]
    if not stretches and "/" not in last:
        return last
    return "schedule:" + ",".join([*(f"{name}={steps}" for name, steps in stretches), last])


def search(
    outcomes: Outcomes, seeds: Sequence[int], prices: Sequence[float], population: int = 32, rounds: int = 8
) -> Iterator[int]:
    """Search for the orders of models with the highest meta-reward, for each start and price separately.

    This is an evolution strategy. Round 1 tries one rung up to some step and another one from there on, the same for
    every start; each further round tries mutants of the best order so far, see `mutant`. What was tried for one price
    counts for all. After the last round, every start tries what is best for the others.

    The same arguments give the same orders, on any number of devices, and when an interrupted search is resumed.

    Args:
        outcomes: the scenario, and where its episodes are kept.
        seeds: of the starts.
        prices: lambdas [reward per second].
        population: orders per start, price and round.
        rounds: how often orders are tried, the first ones included.

    Yields:
        The number of each round that is done, from 1; and one more, when starts have tried each other's best orders.
    """
    random, batch = np.random.default_rng(0), outcomes.batch
    rungs, steps = range(len(batch.rungs)), np.arange(batch.steps)[:, None].repeat(batch.humans, axis=1)
    ends = np.unique(np.round(np.geomspace(1, batch.steps, SWITCHES)).astype(int))
    drawn = [np.where(steps < end, *pair) for end in ends for pair in product(rungs, rungs)]
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


def mutant(random: np.random.Generator, order: Array, rungs: int) -> Array:
    """Return an order [steps, humans] with another rung in one or two stretches of steps, for all humans or for one."""
    new, (steps, humans) = order.copy(), order.shape
    for _ in range(random.integers(1, 3)):
        start, length = random.integers(steps), random.geometric(1 / MEAN_STRETCH)
        alone = humans > 1 and random.random() < SINGLE_SHARE
        new[start : start + length, random.integers(humans) if alone else slice(None)] = random.integers(rungs)
    return new


def best(table: pd.DataFrame, seeds: Sequence[int], price: float) -> pd.DataFrame:
    """Return, by seed, the row of the highest meta-reward, ``r_R - lambda T(M)`` per step, with that in a column.

    It may be that of any controller: its choices are an order of models, too.

    Args:
        table: of `Outcomes`.
        seeds: of the starts.
        price: lambda [reward per second].
    """
    rows = table.query("seed in @seeds").reset_index()
    rows["meta_reward"] = rows["reward"] - price * rows["counted_seconds"]
    return rows.loc[rows.groupby("seed")["meta_reward"].idxmax()].set_index("seed")


def regrets(table: pd.DataFrame, controllers: Sequence[str], seeds: Sequence[int], price: float) -> pd.DataFrame:
    """Compute how far controllers stay behind the best order that was found for each start.

    Args:
        table: of `Outcomes`.
        controllers: short names; their lambdas may be others than the price.
        seeds: of the starts.
        price: lambda of the meta-reward [reward per second of planning].

    Returns:
        A row per ``controller``, `BEST_PER_START` the last: ``kind``; ``reward`` and ``counted_seconds`` per step, as
        means over starts; ``meta_reward``; ``regret``, and ``regret_low`` and ``regret_high``, the 90 % interval of its
        mean over starts (Student's t). Among the controllers is the order with the highest
        mean meta-reward of those that were tried from every start.

    Raises:
        KeyError: if a controller was not driven from every start.
    """
    found, net = best(table, seeds, price), table["reward"] - price * table["counted_seconds"]
    everywhere = net.unstack("seed")[list(seeds)].dropna().mean(axis=1)
    kinds = everywhere.index.map(lambda name: controller_config(name)["type"])
    names = dict.fromkeys([*controllers, str(everywhere[kinds.isin(fixed_order_types())].idxmax())])
    driven = {name: table.loc[[(name, seed) for seed in seeds]].droplevel("controller") for name in names}
    rows = []
    for name, own in {**driven, BEST_PER_START: found}.items():
        earned = own["reward"] - price * own["counted_seconds"]
        behind = found["meta_reward"] - earned
        row = {"controller": name, "kind": "search" if own is found else controller_config(name)["type"]}
        row |= own[["reward", "counted_seconds"]].mean()
        row |= {"meta_reward": earned.mean(), "regret": behind.mean()}
        rows.append(row | dict(zip(("regret_low", "regret_high"), interval(behind), strict=True)))
    return pd.DataFrame(rows)
