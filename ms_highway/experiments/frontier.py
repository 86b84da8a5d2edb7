"""The best orders of models, found by search: a lower bound on what any choice of models can have.

From a known start nothing in an episode is left to chance, so that no rule for choosing models, however clever, earns
more than the best order of models for that very start. What a search finds is as good as that, or worse.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby, product
from pathlib import Path

import numpy as np
import pandas as pd
from jax.sharding import Mesh

from ms_highway.experiments.batch import Batch, Key
from ms_highway.experiments.records import check_numbers
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.files import reading, replacing

STRETCH = 4  # steps, mean of their number in a stretch that is changed
ALONE = 0.5  # of the changes among several humans: for a single one
SWITCHES = 12  # steps at which the first orders go over from one rung to another
INDEX = ["controller", "seed"]
KEPT_COLUMNS = {"scenario": str, "reward": float, "counted_seconds": float, "collisions": int, "fallbacks": int}


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
                check_numbers(known)
                self.table = known.set_index(INDEX)[list(KEPT_COLUMNS)]

    def of(self, keys: Sequence[Key]) -> pd.DataFrame:
        """Return the rows of some episodes, in their order; simulate and keep those that are not known."""
        lacking = [key for key in dict.fromkeys(keys) if key not in self.table.index]
        if lacking:
            steps = self.batch.steps_table(lacking, self.batch.simulate(lacking, self._mesh))
            fresh = self.batch.episodes_table(steps).set_index(INDEX)[list(KEPT_COLUMNS)]
            self.table = pd.concat([self.table, fresh]) if len(self.table) else fresh
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
    keys = [(name, seed) for seed in seeds for name in orders]
    tried: dict[int, dict[str, tuple[float, float]]] = {seed: {} for seed in seeds}  # reward, seconds per step
    for number in range(1, rounds + 1):
        rows = outcomes.of(keys)[["reward", "counted_seconds"]]
        for (name, seed), outcome in zip(keys, rows.itertuples(index=False, name=None), strict=True):
            tried[seed][name] = outcome
        best, keys = set[str](), []
        for seed, price in product(seeds, prices):
            net = {name: reward - price * seconds for name, (reward, seconds) in tried[seed].items()}
            leader = max(net, key=net.__getitem__)
            best.add(leader)
            for _ in range(population):
                order = mutant(random, orders[leader], len(rungs))
                name = controller_name(batch.rungs, order)
                orders[name] = order
                keys.append((name, seed))
        yield number
    outcomes.of(list(product(sorted(best), seeds)))
    yield rounds + 1


def mutant(random: np.random.Generator, order: Array, rungs: int) -> Array:
    """Return an order [steps, humans] with another rung in one or two stretches of steps, for all humans or for one."""
    new, (steps, humans) = order.copy(), order.shape
    for _ in range(random.integers(1, 3)):
        start, length = random.integers(steps), random.geometric(1 / STRETCH)
        alone = humans > 1 and random.random() < ALONE
        new[start : start + length, random.integers(humans) if alone else slice(None)] = random.integers(rungs)
    return new
