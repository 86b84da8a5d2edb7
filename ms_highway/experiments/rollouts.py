"""Roll out the models of a ladder from visited situations: what the value of computation is learned from.

The nearest humans, one, two or more, are predicted by each model for some steps, the others naively; then all of them
naively or by the learned rule.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jax.sharding import Mesh

from ms_highway.choice.learned_value import TOGETHER, LearnedValue
from ms_highway.choice.situation import describe, nearness
from ms_highway.experiments.batch import Batch
from ms_highway.game.game import Game
from ms_highway.loop.batch import simulate
from ms_highway.loop.records import DECIDES, PLANS, Episodes, Records
from ms_highway.runtime.arrays import Array

Random: TypeAlias = np.random.Generator

WORST_STEP = 1e3  # reward of a step, where plans fail and cars leave the world

# with one human, and among several:
MAX_NOISE = 4.0, 1.0  # see `Course.starts`
STATES_OF_AN_EPISODE = 4, 6
STAYS = 0.8, 0.9  # probability that a random order keeps its rungs for another step
MIN_LIKELY = 1.0, 0.3  # state to be drawn, where driving at the limit on the way to the lane counts 1


class Rollouts(NamedTuple):
    """What was gained from states by the rungs.

    Attributes:
        descriptions: of the situations [examples, numbers], see `ms_highway.choice.situation`.
        gains: over the first rung, where nearer humans have the same rung in both cases, per step that it was held
            [examples, rungs - 1]; -inf where a rung is not on the course's ladder.
    """

    descriptions: Any
    gains: Any


@dataclass(frozen=True)
class Course:
    """A scenario in which values are learned.

    Attributes:
        batch: draws and simulates its episodes.
        rungs: places of its own ladder in the ladder that is learned.
    """

    batch: Batch
    rungs: tuple[int, ...]

    @property
    def name(self) -> str:
        """The name of the scenario."""
        return self.batch.environment.scenario.name

    @property
    def game(self) -> Game:
        """The game that is played."""
        return self.batch.loop.game

    @property
    def several(self) -> bool:
        """Whether there are several humans."""
        return self.batch.humans > 1

    @property
    def steps(self) -> int:
        """The number of steps of an episode from which states are drawn."""
        return self.batch.steps

    def starts(self, random: Random, count: int) -> tuple[Array, Array]:
        """Draw starts [count, cars, 4] and the weights of the humans' rewards [count, humans, features].

        With one human, a start is ``a + c (b - a)`` with two draws a and b, which has their mean and
        ``sqrt(c^2 + (1 - c)^2)`` times their standard deviation; c is drawn from 1 to `MAX_NOISE`.
        """
        drawn = [self.batch.environment.draw_episode(random) for _ in range(2 * count)]
        starts, weights = (np.array(part, np.float32) for part in zip(*drawn, strict=True))
        noise = random.uniform(1.0, MAX_NOISE[self.several], (count, 1, 1)).astype(np.float32)
        return starts[::2] + noise * (starts[1::2] - starts[::2]), weights[::2]

    def orders(self, random: Random, count: int) -> Array:
        """Draw orders of models that keep their rungs for some steps, [count, steps, humans].

        Frequencies of rungs differ from order to order. Among several humans, all change at once, each to a rung of its
        own.
        """
        rungs, shape = len(self.rungs), (self.steps, self.batch.humans)
        orders = np.zeros((count, *shape), np.int32)
        for order, share in zip(orders, random.dirichlet(np.ones(rungs), count), strict=True):
            drawn = random.choice(rungs, shape, p=share)
            changes = random.random(self.steps) > STAYS[self.several]
            order[:] = drawn[np.maximum.accumulate(np.where(changes, np.arange(self.steps), 0))]
        return orders


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
    settings: Mapping = field(default_factory=dict)


@dataclass(frozen=True)
class Driving:
    """How a course is driven.

    Attributes:
        course: where.
        how: values are learned.
        rule: that was learned last, on the course's ladder.
        learned: whether it was; otherwise it is not used.
        mesh: devices.
    """

    course: Course
    how: Learning
    rule: LearnedValue
    learned: bool
    mesh: Mesh

    def drive(self, starts: Any, weights: Any, schedules: Any, prices: Any) -> Records:
        """Simulate episodes, with models by schedule or by the rule.

        Whatever their length, they are simulated as many steps at a time as a rollout has, so that a course is compiled
        once; every such segment starts cold.

        Args:
            starts: of all cars [episodes, cars, 4].
            weights: of the humans' rewards [episodes, humans, features].
            schedules: the rung of every human [episodes, steps, humans].
            prices: lambdas [episodes], or the same for all.
        """
        loop, horizon = replace(self.course.batch.loop, rule=self.rule), self.how.horizon
        count, steps, humans = schedules.shape
        lambdas = np.full(count, prices, np.float32)
        robot = np.tile(np.asarray(loop.game.robot.weights, np.float32), (count, 1))
        usual, parts = np.full((count, humans), PLANS), []
        last = np.minimum(np.arange(steps + -steps % horizon), steps - 1)  # whole rollouts
        for part in np.split(schedules[:, last].astype(np.int32), len(last) // horizon, axis=1):
            parts.append(simulate(loop, Episodes(starts, lambdas, part, robot, weights, usual), self.mesh))
            starts = np.asarray(parts[-1].states[:, -1])
        return jax.tree.map(lambda *columns: np.concatenate(columns, axis=1)[:, :steps], *parts)

    def roll_out(self, random: Random, count: int) -> Rollouts:
        """Visit so many states and roll out from them.

        From each state, one, two and up to `TOGETHER` of the nearest humans are predicted by every rung for some steps,
        and all others naively; then all by the learned rule or, before there is one, naively. The rule is followed at
        the geometric mean of the prices.
        """
        states, weights = self._visited(random, count)
        own, humans, how = self.course.rungs, self.course.batch.humans, self.how
        held = min(how.held, how.horizon)
        ranks = np.asarray(_rank(self.course.game, states))
        asked = min(TOGETHER, humans)
        ways = [(0, 0), *product(range(1, len(own)), range(1, asked + 1))]  # rung, and how many humans have it
        schedules = np.full((len(states), len(ways), how.horizon, humans), DECIDES if self.learned else 0, np.int32)
        for place, (rung, number) in enumerate(ways):
            schedules[:, place, :held] = np.where(ranks < number, rung, 0)[:, None]
        starts, drivers = (np.repeat(part, len(ways), axis=0) for part in (states, weights))
        price = float(np.sqrt(np.prod(how.prices)))
        rewards = self.drive(starts, drivers, schedules.reshape(-1, how.horizon, humans), price).reward
        earned = np.clip(np.nan_to_num(rewards, nan=-WORST_STEP), -WORST_STEP, None).sum(axis=1, dtype=float)
        naive, others = np.split(earned.reshape(len(states), -1) / held, [1], axis=1)
        others = others.reshape(len(states), -1, asked)
        nobody = np.broadcast_to(naive[:, None], (*others.shape[:2], 1))
        each_more = np.diff(np.concatenate([nobody, others], axis=2), axis=2)  # [states, rungs, humans]
        gains = np.full((len(states) * asked, len(how.costs) - 1), -np.inf)
        gains[:, np.array(own[1:], int) - 1] = np.swapaxes(each_more, 1, 2).reshape(len(gains), -1)
        nearest = np.argsort(ranks, axis=1)[:, :asked]
        described = np.asarray(_describe(self.course.game, states))[np.arange(len(states))[:, None], nearest]
        return Rollouts(described.reshape(len(gains), -1), gains)

    def _visited(self, random: Random, count: int) -> tuple[Array, Array]:
        """Draw states that episodes come through, planned by random orders and by the rule, and the humans' weights.

        A learned rule plans half of the episodes; with one human, it takes over in the others. Among several, states
        of robots that drive and have not reached their lane are drawn more often: predictions hardly matter in others.
        """
        course, steps, game = self.course, self.course.steps, self.course.game
        each = STATES_OF_AN_EPISODE[course.several]
        number = ceil(count / each)
        starts, weights = course.starts(random, number)
        orders = course.orders(random, number)
        if self.learned:
            later = steps if course.several else random.integers(1, steps // 2, number)
            takes_over = np.where(random.random(number) < 0.5, 0, later)
            orders[np.arange(steps) >= takes_over[:, None]] = DECIDES
        least, most = np.log(self.how.prices)
        prices = np.exp(random.uniform(least, most, number))
        after = self.drive(starts, weights, orders, prices).states
        states = np.concatenate([starts[:, None], after[:, :-1]], axis=1)
        finite = np.isfinite(states).all(axis=(1, 2, 3))
        states, weights = states[finite], weights[finite]
        away = np.abs(states[:, :, 0, 1] - float(game.scene.target_lane)) > float(game.scene.lane_width) / 2
        likely = away * states[:, :, 0, 3] / float(game.robot.speed_limit)
        likely = np.clip(likely, MIN_LIKELY[course.several], 1.0)
        likely /= likely.sum(axis=1, keepdims=True)
        visited = [own[random.choice(steps, each, replace=False, p=p)] for own, p in zip(states, likely, strict=True)]
        return np.concatenate(visited)[:count], np.repeat(weights, each, axis=0)[:count]


_describe, _rank = (jax.jit(jax.vmap(function, (None, 0))) for function in (describe, nearness))
