"""The best orders of models, found by search: a lower bound on what any choice of models can have.

From a known start nothing in an episode is left to chance, so that no rule for choosing models, however clever, earns
more than the best order of models for that very start. What a search finds is as good as that, or worse.
"""

from collections.abc import Iterator, Sequence
from itertools import groupby
from math import ceil
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pandas as pd
from jax.sharding import Mesh
from jaxtyping import Float

from ms_highway.experiments.resuming import cannot_resume, missing
from ms_highway.experiments.simulated import Batch, Key, run_episodes, summarised
from ms_highway.runtime.files import replacing

__all__ = ["Order", "Outcomes", "controller_name", "search"]

Order: TypeAlias = tuple[int, ...]
"""The rung that plans each step of an episode."""

ELITE = 0.15  # of the population: how many of the best orders the next ones are drawn like
SMOOTHING = 0.3  # of the old frequencies that is kept
FLOOR = 0.02  # probability of every rung at every step at least, so that none is given up
MUTANTS = 0.5  # of the population: the best order so far but for a stretch of steps
STRETCH = 4  # steps, mean of their number in such a stretch
SWITCHES = 12  # steps at which the first orders go over from one rung to another
PRICES_AT_ONCE = 3  # that a round searches; of more, they take turns
INDEX = ["controller", "seed"]
KEPT_COLUMNS = {"scenario": str, "reward": float, "counted_seconds": float, "collisions": int, "fallbacks": int}


class Outcomes:
    """Episodes of one scenario, each of which is simulated once.

    Attributes:
        batch: the scenario, see `ms_highway.experiments.simulated.make_batch`.
        table: what is known, by controller and seed: ``scenario``, ``reward``, ``counted_seconds``, ``collisions`` and
            ``fallbacks`` as in `ms_highway.experiments.simulated.summarised`.
    """

    def __init__(self, batch: Batch, file: Path | None = None, mesh: Mesh | None = None) -> None:
        """Begin with what a file knows.

        Args:
            batch: the scenario.
            file: where all outcomes are kept, as CSV; without, nowhere.
            mesh: devices, see `ms_highway.simulation.devices.device_mesh`.

        Raises:
            ValueError: if the file is there and holds something else.
        """
        self.batch, self._file, self._mesh = batch, file, mesh
        self.table = pd.DataFrame() if file is None or not file.exists() else _read(file)

    def of(self, keys: Sequence[Key]) -> pd.DataFrame:
        """Return the rows of some episodes, in their order; simulate and keep those that are not known."""
        lacking = missing(keys, self.table.index)
        if lacking:
            records = run_episodes(self.batch, lacking, self._mesh)
            fresh = summarised(self.batch, lacking, records).set_index(INDEX)[list(KEPT_COLUMNS)]
            self.table = fresh if self.table.empty else pd.concat([self.table, fresh])
            if self._file is not None:
                with replacing(self._file) as path:
                    self.table.to_csv(path)
        return self.table.loc[list(keys)]


def _read(file: Path) -> pd.DataFrame:
    try:
        table = pd.read_csv(
            file, converters=KEPT_COLUMNS
        )  # Python's float gives back the very numbers that were written
        return table.set_index(INDEX)[list(KEPT_COLUMNS)]
    except (ValueError, KeyError) as error:
        raise cannot_resume(file, error, "remove it or choose another directory") from error


def controller_name(models: Sequence[str], order: Order) -> str:
    """Return the short name of the controller that plans with these models: ``schedule:tom=6,naive``, ``tom``."""
    *stretches, (last, _) = [(models[rung], len(list(steps))) for rung, steps in groupby(order)]
    return "schedule:" + ",".join([*(f"{name}={steps}" for name, steps in stretches), last]) if stretches else last


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
    random, models = np.random.default_rng(0), [model.name for model in outcomes.batch.loop.rule.ladder]
    even = np.full((outcomes.batch.steps, len(models)), 1 / len(models))
    tables = {(seed, price): even for seed in seeds for price in prices}
    tried: dict[int, dict[Order, tuple[float, float]]] = {seed: {} for seed in seeds}  # reward, seconds per step
    leaders: dict[tuple[int, float], list[Order]] = {}
    ascending = sorted(set(prices))
    turns = max(1, ceil(len(ascending) / PRICES_AT_ONCE))
    for number in range(1, rounds + 1):
        searched = ascending[number % turns :: turns]
        drawn = [
            (order, seed)
            for seed, price in tables
            if price in searched
            for order in (
                _candidates(random, tables[seed, price], leaders[seed, price][0], population)
                if leaders
                else _first(*even.shape)
            )
        ]
        rows = outcomes.of([(controller_name(models, order), seed) for order, seed in drawn])
        earned = rows[["reward", "counted_seconds"]].itertuples(index=False, name=None)
        for (order, seed), outcome in zip(drawn, earned, strict=True):
            tried[seed][order] = outcome
        for seed, price in tables:
            own = {order: reward - price * seconds for order, (reward, seconds) in tried[seed].items()}
            leaders[seed, price] = sorted(own, key=lambda order: own[order], reverse=True)
            elite = leaders[seed, price][: max(2, round(ELITE * population))]
            frequencies = np.eye(len(models))[np.array(elite)].mean(axis=0)
            mixed = np.maximum(SMOOTHING * tables[seed, price] + (1 - SMOOTHING) * frequencies, FLOOR)
            tables[seed, price] = mixed / mixed.sum(axis=-1, keepdims=True)
        yield number
    exchanged = dict.fromkeys(controller_name(models, orders[0]) for orders in leaders.values())
    outcomes.of([(name, seed) for seed in seeds for name in exchanged])
    yield rounds + 1


def _first(steps: int, rungs: int) -> list[Order]:
    """Return the orders of one rung up to some step and another one from there on."""
    ends = np.unique(np.round(np.geomspace(1, steps, SWITCHES)).astype(int)).tolist()
    return [(one,) * end + (other,) * (steps - end) for end in ends for one in range(rungs) for other in range(rungs)]


def _candidates(
    random: np.random.Generator, table: Float[np.ndarray, "steps rungs"], leader: Order, population: int
) -> list[Order]:
    """Orders that are drawn from a table of probabilities, and mutants of the best one so far."""
    steps, rungs = table.shape
    mutants, bounds = round(MUTANTS * population), table.cumsum(axis=-1)[:, :-1]
    candidates = [
        tuple((random.random((steps, 1)) > bounds).sum(axis=-1).tolist()) for _ in range(population - mutants)
    ]
    for _ in range(mutants):
        start, length, rung = random.integers(steps), random.geometric(1 / STRETCH), int(random.integers(rungs))
        candidates.append(tuple(rung if start <= step < start + length else now for step, now in enumerate(leader)))
    return candidates
