"""The best orders of models, found by search: a lower bound on what any choice of models can have.

From a known start nothing in an episode is left to chance, so that no rule for choosing models, however clever, earns
more than the best order of models for that very start. What a search finds is as good as that, or worse.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby, product
from math import ceil
from pathlib import Path

import numpy as np
import pandas as pd
from jax.sharding import Mesh

from ms_highway.experiments.batch import Batch, Key
from ms_highway.experiments.records import check_numbers
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.files import reading, replacing

ELITE = 0.15  # of the population: how many of the best orders the next ones are drawn like
SMOOTHING = 0.3  # of the old frequencies that is kept
FLOOR = 0.02  # probability of every rung at every step at least, so that none is given up
MUTANTS = 0.5  # of the population: the best order so far but for a stretch of steps
STRETCH = 4  # steps, mean of their number in such a stretch
SWITCHES = 12  # steps at which the first orders go over from one rung to another
ALONE = 0.5  # of the mutants among several humans: another rung for a single human
PRICES_AT_ONCE = 3  # that a round searches; of more, they take turns
INDEX = ["controller", "seed"]
KEPT_COLUMNS = {"scenario": str, "reward": float, "counted_seconds": float, "collisions": int, "fallbacks": int}


class Outcomes:
    """Episodes of one scenario, each of which is simulated once.

    Attributes:
        batch: the scenario.
        table: what is known, by controller and seed: ``scenario``, ``reward``, ``counted_seconds``, ``collisions`` and
            ``fallbacks`` as in `ms_highway.experiments.records.per_episode`.
    """

    def __init__(self, batch: Batch, file: Path | None = None, mesh: Mesh | None = None) -> None:
        """Begin with what a file knows.

        Args:
            batch: the scenario.
            file: where all outcomes are kept, as CSV; without, nowhere.
            mesh: devices, see `ms_highway.loop.devices.device_mesh`.

        Raises:
            ValueError: if the file is there and holds something else.
        """
        self.batch, self._file, self._mesh = batch, file, mesh
        self.table = pd.DataFrame(columns=[*INDEX, *KEPT_COLUMNS]).set_index(INDEX)
        if file is not None and file.exists():
            with reading(file, "remove it or choose another directory"):
                # Python's float gives back the very numbers that were written.
                known = pd.read_csv(file, converters=KEPT_COLUMNS)
                check_numbers(known)
                self.table = known.set_index(INDEX)[list(KEPT_COLUMNS)]

    def of(self, keys: Sequence[Key]) -> pd.DataFrame:
        """Return the rows of some episodes, in their order; simulate and keep those that are not known."""
        lacking = [key for key in dict.fromkeys(keys) if key not in self.table.index]
        if lacking:
            steps = self.batch.steps_table(lacking, self.batch.simulate(lacking, self._mesh))
            fresh = self.batch.episodes_table(steps).set_index(INDEX)[list(KEPT_COLUMNS)]
            self.table = pd.concat([self.table, fresh]) if len(self.table) else fresh
            if self._file is not None:
                with replacing(self._file) as path:
                    self.table.to_csv(path)
        return self.table.loc[list(keys)]


def controller_name(models: Sequence[str], order: Array) -> str:
    """Return the short name of the controller that plans with these models: ``schedule:tom=6,naive``, ``tom``.

    Models that differ between humans are named one by one: ``schedule:tom/naive=6,naive``.

    Args:
        models: names of the rungs.
        order: the rung of every human in each step, [steps, humans].
    """
    names = (
        "/".join(models[rung] for rung in (rungs if len(set(rungs)) > 1 else rungs[:1])) for rungs in order.tolist()
    )
    *stretches, (last, _) = [(name, len(list(steps))) for name, steps in groupby(names)]
    if not stretches and "/" not in last:
        return last
    return "schedule:" + ",".join([*(f"{name}={steps}" for name, steps in stretches), last])


def search(
    outcomes: Outcomes, seeds: Sequence[int], prices: Sequence[float], population: int = 32, rounds: int = 8
) -> Iterator[int]:
    """Search for the orders of models with the highest meta-reward, for each start and price separately.

    Half of a round's orders are from the cross-entropy method (Rubinstein and Kroese 2004): a table holds the
    probability p[k, m] of rung m at step k, orders are drawn from it rung by rung, and it moves towards the frequencies
    f of rungs among the best orders so far, ``p <- SMOOTHING p + (1 - SMOOTHING) f``. The other half is the best order
    so far with some rung in a short stretch of steps: it refines, where the first half keeps looking elsewhere. Round 1
    tries one rung up to some step and another one from there on, the same for every start. What was tried for one price
    counts for all. Later rounds search for three prices at most: more take turns, every third price or so in one round,
    so that they cost little more. After the last round, every start tries what is best for the others.

    Among several humans, orders of all rungs of all humans are too many: what is drawn and tried first has the same
    rung for all humans in a step, and half of the refinements change the rung of a single human.

    The same arguments give the same orders, on any number of devices, and when an interrupted search is resumed.

    Args:
        outcomes: the scenario, and where its episodes are kept.
        seeds: of the starts.
        prices: lambdas [reward per second].
        population: orders per start, searched price and round.
        rounds: how often orders are drawn, the first ones included.

    Yields:
        The number of each round that is done, from 1; and one more, when starts have tried each other's best orders.
    """
    random, batch = np.random.default_rng(0), outcomes.batch
    rungs, shape = len(batch.rungs), (batch.steps, batch.humans)
    ascending = sorted(set(prices))
    turns = ceil(len(ascending) / PRICES_AT_ONCE)
    tables = {(seed, price): np.full((batch.steps, rungs), 1 / rungs) for seed in seeds for price in prices}
    orders: dict[str, Array] = {}
    tried: dict[int, dict[str, tuple[float, float]]] = {seed: {} for seed in seeds}  # reward, seconds per step
    best: dict[tuple[int, float], str] = {}
    for number in range(1, rounds + 1):
        keys = []
        for (seed, price), table in tables.items():
            if price in ascending[number % turns :: turns]:
                drawn = _next(random, table, orders[best[seed, price]], population) if best else _first(shape, rungs)
                named = {controller_name(batch.rungs, order): order for order in drawn}
                orders |= named
                keys += [(name, seed) for name in named]
        rows = outcomes.of(keys)[["reward", "counted_seconds"]]
        for (name, seed), outcome in zip(keys, rows.itertuples(index=False, name=None), strict=True):
            tried[seed][name] = outcome
        for (seed, price), table in tables.items():
            own = {name: reward - price * seconds for name, (reward, seconds) in tried[seed].items()}
            leaders = sorted(own, key=own.__getitem__, reverse=True)[: max(2, round(ELITE * population))]
            best[seed, price] = leaders[0]
            frequencies = np.eye(rungs)[np.array([orders[name] for name in leaders])].mean(axis=(0, 2))
            mixed = np.maximum(SMOOTHING * table + (1 - SMOOTHING) * frequencies, FLOOR)
            tables[seed, price] = mixed / mixed.sum(axis=-1, keepdims=True)
        yield number
    outcomes.of([(name, seed) for seed in seeds for name in dict.fromkeys(best.values())])
    yield rounds + 1


def _first(shape: tuple[int, int], rungs: int) -> Iterator[Array]:
    """Yield the orders of one rung up to some step and another one from there on."""
    ends = np.unique(np.round(np.geomspace(1, shape[0], SWITCHES)).astype(int))
    for end, *pair in product(ends, range(rungs), range(rungs)):
        yield np.where(np.arange(shape[0]) < end, *pair)[:, None].repeat(shape[1], axis=1)


def _next(random: np.random.Generator, table: Array, leader: Array, population: int) -> Iterator[Array]:
    """Yield orders that are drawn from a table of probabilities, and mutants of the best one so far."""
    steps, humans = leader.shape
    mutants, bounds = round(MUTANTS * population), table.cumsum(axis=-1)[:, :-1]
    for _ in range(population - mutants):
        yield np.tile((random.random((steps, 1)) > bounds).sum(axis=-1)[:, None], humans)
    for _ in range(mutants):
        start, length, rung = random.integers(steps), random.geometric(1 / STRETCH), random.integers(table.shape[1])
        alone, mutant = humans > 1 and random.random() < ALONE, leader.copy()
        mutant[start : start + length, random.integers(humans) if alone else slice(None)] = rung
        yield mutant
