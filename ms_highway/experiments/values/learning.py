"""Learn the value of computation: rollouts and fits, round by round, as cost-sensitive policy iteration.

Rollouts of later rounds follow the rule that was fitted last, and their states are those that this rule comes through.
Every number is drawn from its own stream, so that a seed gives the same values, whether learning was interrupted or
not, and on any number of devices.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from zlib import crc32

import jax
import numpy as np
from jax.sharding import Mesh

from ms_highway.choice.learned_value import TOGETHER
from ms_highway.choice.situation import description_names
from ms_highway.choice.values import Values
from ms_highway.experiments.directory import ResultsDirectory
from ms_highway.experiments.values.fitting import fit, new_network
from ms_highway.experiments.values.rollouts import Course, Driving, Random, Rollouts
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import human_model
from ms_highway.runtime.files import read_arrays, reading, replacing

REMEDY = "remove it, or choose another --out"
LEAST_SPREAD = 1e-3  # of an input
COURSE, FIT = 1, 2  # streams of random numbers


@dataclass(frozen=True)
class Learning:
    """How values are learned.

    Attributes:
        costs: T(M) by model, cheapest first [s]: the ladder.
        prices: the least and the largest lambda at which the rule is followed to the states that rollouts start from.
        rounds: of rollouts and fits.
        states: that rollouts start from, on each course, in the first round and in the others.
        horizon: steps of a rollout.
        held: of them, with the rung whose gain is learned.
        seed: of all random numbers, which have nothing to do with the numbered starts of environments.
        settings: what the file of values tells beside this.
    """

    costs: Mapping[str, float]
    prices: tuple[float, float] = (1e-3, 10.0)
    rounds: int = 4
    states: tuple[int, int] = (400, 250)
    horizon: int = 20
    held: int = 4
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what a file of values could not hold.

        Raises:
            ValueError: naming it.
        """
        self.values([], 0)

    def driving(self, course: Course, values: Values | None, mesh: Mesh) -> Driving:
        """Return how a course is driven, before any values are learned, with a rule that is not used."""
        names = [list(self.costs)[rung] for rung in course.rungs]
        costs = Costs.of([self.costs[name] for name in names], course.game.number)
        rule = (values or self.values([], 0)).rule(tuple(map(human_model, names)), costs, self.prices[0])
        return Driving(course, rule, values is not None, self.prices, self.horizon, min(self.held, self.horizon), mesh)

    def values(self, done: Sequence[Rollouts], number: int) -> Values:
        """Fit values to rollouts in round ``number``, from 1."""
        random, names = self.stream(number, FIT), description_names()
        network = new_network(random, len(names), len(self.costs) - 1)
        centre, spread = np.zeros(len(names)), np.ones(len(names))
        if done:
            rollouts = Rollouts(*map(np.concatenate, zip(*done, strict=True)))
            centre = rollouts.descriptions.mean(axis=0)
            spread = rollouts.descriptions.std(axis=0) + LEAST_SPREAD
            network = fit(network, rollouts, centre, spread, random)
        examples = sum(len(part.descriptions) for part in done)
        settings = {"examples": examples, "rounds": number, "horizon": self.horizon, "held": self.held}
        settings["together"] = TOGETHER
        return Values(network, centre, spread, tuple(self.costs), names, {**self.settings, **settings})

    def stream(self, *place: int) -> Random:
        """Return the random numbers of a place, such as a round and the number of a course."""
        return np.random.default_rng([self.seed, *place])


def learn(learning: Learning, courses: Sequence[Course], kept: Path, mesh: Mesh) -> Iterator[tuple[str, Values | None]]:
    """Learn values on some courses.

    Args:
        learning: how.
        courses: where.
        kept: directory of all rollouts, from which an interrupted run goes on; removed by the caller at the end.
        mesh: devices, see `ms_highway.loop.devices.device_mesh`.

    Yields:
        What was done, after the rollouts of each course and after each fit, and the values after a fit.

    Raises:
        ValueError: if the directory is there and holds something else.
    """
    games = []
    for course in courses:
        numbers = [np.asarray(leaf, np.float32).tobytes() for leaf in jax.tree.leaves(course.game)]
        games.append((course.name, course.steps, course.rungs, crc32(b"".join(numbers))))
    settings = {**asdict(learning), "courses": games}
    ResultsDirectory(kept).take_up(settings)
    ResultsDirectory(kept).write_settings(settings)
    values, done = None, list[Rollouts]()
    for number in range(1, learning.rounds + 1):
        for place, course in enumerate(courses):
            file = kept / f"{number}-{place}.npz"
            if not file.exists():
                count = learning.states[number > 1]
                driving, random = learning.driving(course, values, mesh), learning.stream(number, COURSE, place)
                with replacing(file) as path:
                    np.savez(path, **driving.roll_out(random, count, len(learning.costs))._asdict())
            done.append(read_rollouts(file))
            yield f"round {number} of {learning.rounds}: {course.name}", None
        values = learning.values(done, number)
        yield f"round {number} of {learning.rounds}: fitted", values


def read_rollouts(file: Path) -> Rollouts:
    """Read rollouts that an interrupted run has kept.

    Raises:
        ValueError: if the file is damaged, or holds numbers that are not finite.
    """
    with reading(file, REMEDY):
        kept = Rollouts(**read_arrays(file, file.stat().st_size))  # it is not compressed
        if not np.isfinite(kept.descriptions).all() or not (kept.gains < np.inf).all():
            raise ValueError("it holds numbers that are not finite")
    return kept
