"""Roll out the models of a ladder from visited states; the value of computation is
learned from these examples.

In a rollout, a model predicts one or more of the nearest humans for some steps, and
naive predicts the others. Then naive predicts all of them, or the learned rule chooses.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from ms_highway.choice.choosers import PriceTogether
from ms_highway.choice.rule import GameEvidence, Rule
from ms_highway.choice.situation import describe, nearness
from ms_highway.experiments.batch import Batch
from ms_highway.loop.batch import simulate
from ms_highway.loop.records import DECIDES, HUMAN_PLANS, Episodes, Records
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import Devices

Random: TypeAlias = np.random.Generator

# largest loss that counts in a step, as plans may fail and cars may leave the world
WORST_STEP = 1e3


class Rollouts(NamedTuple):
    """Gains of the rungs in visited states, with an example for each of the nearest
    humans.

    Attributes:
        descriptions: descriptions of the situations [examples, numbers], see
            `ms_highway.choice.situation`.
        gains: gain per step if a rung, instead of the first one, predicts a human,
            while this rung predicts all nearer humans [examples, rungs - 1]; -inf if
            the rung is not on the scenario's ladder.
    """

    descriptions: Any
    gains: Any


@dataclass(frozen=True)
class Learning:
    """Settings of learning. The defaults are for one human, `SEVERAL` those for
    several.

    Attributes:
        costs: T(M) of the models of the ladder, cheapest first [s].
        prices: least and largest lambda at which the rule drives to the states from
            which rollouts start.
        rounds: number of rounds of rollouts and fits.
        states: number of states from which rollouts start, in each scenario, in the
            first round and in each later one.
        horizon: number of steps of a rollout.
        held: number of these steps with the rung whose gain is learned.
        noise: largest c of `Driving.starts`.
        states_of_an_episode: number of states that are drawn from an episode.
        stays: probability that a random order keeps its rungs for another step.
        min_likely: least weight with which a state is drawn; at the speed limit outside
            the target lane, it is 1.
        seed: seed of all random numbers, which are independent of the seeds of
            environments.
        settings: further entries of the provenance of the values.
    """

    costs: Mapping[str, float]
    prices: tuple[float, float] = (1e-3, 10.0)
    rounds: int = 4
    states: tuple[int, int] = (400, 250)
    horizon: int = 20
    held: int = 4
    noise: float = 4.0
    states_of_an_episode: int = 4
    stays: float = 0.8
    min_likely: float = 1.0
    seed: int = 0
    settings: Mapping = field(default_factory=dict)


SEVERAL: dict = {
    "prices": (30.0, 30.0),
    "rounds": 2,
    "states": (100, 100),
    "horizon": 25,
    "held": 25,
    "noise": 1.0,
    "states_of_an_episode": 6,
    "stays": 0.9,
    "min_likely": 0.3,
}
"""Settings of learning among several humans."""


@dataclass(frozen=True)
class Driving:
    """A scenario in which values are learned, and what drives in it.

    Attributes:
        batch: draws and simulates the episodes of the scenario.
        how: settings of learning.
        rule: rule of the last fit, on the scenario's ladder.
        learned: whether there was a fit; otherwise, the rule is not used.
        devices: that simulate it; None for the first.
    """

    batch: Batch
    how: Learning
    rule: Rule[GameEvidence]
    learned: bool
    devices: Devices | None

    def starts(self, random: Random, count: int) -> tuple[Array, Array]:
        """Draw starts [count, cars, 4] and the weights of the humans' rewards [count,
        humans, features].

        A start is ``a + c (b - a)`` with two draws a and b, and with c drawn from 1 to
        `Learning.noise`. It has the mean of the draws, and ``sqrt(c^2 + (1 - c)^2)``
        times their standard deviation.
        """
        drawn = [self.batch.environment.draw_episode(random) for _ in range(2 * count)]
        starts, weights = (
            np.array(part, np.float32) for part in zip(*drawn, strict=True)
        )
        noise = random.uniform(1.0, self.how.noise, (count, 1, 1)).astype(np.float32)
        return starts[::2] + noise * (starts[1::2] - starts[::2]), weights[::2]

    def orders(self, random: Random, count: int) -> Array:
        """Draw orders of models that keep their rungs for some steps, [count, steps,
        humans].

        Each order has frequencies of rungs of its own. Several humans change their
        rungs in the same steps, each to a rung of its own.
        """
        rungs = len(self.batch.rungs)
        steps = self.batch.steps
        orders = np.zeros((count, steps, self.batch.humans), np.int32)
        for order, share in zip(
            orders, random.dirichlet(np.ones(rungs), count), strict=True
        ):
            drawn = random.choice(rungs, order.shape, p=share)
            changes = random.random(steps) > self.how.stays
            order[:] = drawn[
                np.maximum.accumulate(np.where(changes, np.arange(steps), 0))
            ]
        return orders

    def drive(self, starts: Any, weights: Any, schedules: Any, prices: Any) -> Records:
        """Simulate episodes with models from schedules or from the rule.

        Episodes of any length are simulated in segments as long as a rollout, so that a
        scenario is compiled once. Every segment starts without a last plan.

        Args:
            starts: starts of all cars [episodes, cars, 4].
            weights: weights of the humans' rewards [episodes, humans, features].
            schedules: rung of every human [episodes, steps, humans], or `DECIDES` for
                the rule's choice.
            prices: lambdas [episodes], or one for all.
        """
        loop = replace(self.batch.loop, rule=self.rule)
        horizon = self.how.horizon
        count, steps, humans = schedules.shape
        lambdas = np.full(count, prices, np.float32)
        robot = np.tile(np.asarray(loop.game.robot.weights, np.float32), (count, 1))
        usual = np.full((count, humans), HUMAN_PLANS)
        parts = []
        last = np.minimum(
            np.arange(steps + -steps % horizon), steps - 1
        )  # whole rollouts
        for part in np.split(
            schedules[:, last].astype(np.int32), len(last) // horizon, axis=1
        ):
            parts.append(
                simulate(
                    loop,
                    Episodes(starts, lambdas, part, robot, weights, usual),
                    self.devices,
                )
            )
            starts = np.asarray(parts[-1].states[:, -1])
        return jax.tree.map(
            lambda *columns: np.concatenate(columns, axis=1)[:, :steps], *parts
        )

    def roll_out(self, random: Random, count: int) -> Rollouts:
        """Visit ``count`` states and roll out from each of them.

        There is a rollout for every rung and for one, two and up to
        `PriceTogether.most_humans` of the nearest humans. The rung predicts these
        humans for some steps, and naive the others. Then the rule chooses for all, at
        the geometric mean of the prices; before the first fit, naive predicts all.
        """
        states, weights = self._visited(random, count)
        game = self.batch.loop.game
        humans = self.batch.humans
        how = self.how
        own = [list(how.costs).index(name) for name in self.batch.rungs]
        held = min(how.held, how.horizon)
        ranks = np.asarray(_rank(game, states))
        asked = min(PriceTogether.most_humans, humans)
        ways = [
            (0, 0),
            *product(range(1, len(own)), range(1, asked + 1)),
        ]  # rung, and how many humans have it
        schedules = np.full(
            (len(states), len(ways), how.horizon, humans),
            DECIDES if self.learned else 0,
            np.int32,
        )
        for place, (rung, number) in enumerate(ways):
            schedules[:, place, :held] = np.where(ranks < number, rung, 0)[:, None]
        starts, drivers = (
            np.repeat(part, len(ways), axis=0) for part in (states, weights)
        )
        price = float(np.sqrt(np.prod(how.prices)))
        rewards = self.drive(
            starts, drivers, schedules.reshape(-1, how.horizon, humans), price
        ).reward
        earned = np.clip(
            np.nan_to_num(rewards, nan=-WORST_STEP), -WORST_STEP, None
        ).sum(axis=1, dtype=float)
        naive, others = np.split(earned.reshape(len(states), -1) / held, [1], axis=1)
        others = others.reshape(len(states), -1, asked)
        nobody = np.broadcast_to(naive[:, None], (*others.shape[:2], 1))
        each_more = np.diff(
            np.concatenate([nobody, others], axis=2), axis=2
        )  # [states, rungs, humans]
        gains = np.full((len(states) * asked, len(how.costs) - 1), -np.inf)
        gains[:, np.array(own[1:], int) - 1] = np.swapaxes(each_more, 1, 2).reshape(
            len(gains), -1
        )
        nearest = np.argsort(ranks, axis=1)[:, :asked]
        return Rollouts(
            np.asarray(_describe(game, states, nearest)).reshape(len(gains), -1), gains
        )

    def _visited(self, random: Random, count: int) -> tuple[Array, Array]:
        """Draw states from episodes that random orders and the rule have planned;
        return them and the humans' weights.

        After a fit, the rule chooses in half of the episodes and, with one human, in
        the later part of the others. With several humans, states in which the robot
        drives and is not in its lane yet are drawn more often, as predictions hardly
        matter in the others.
        """
        steps = self.batch.steps
        game = self.batch.loop.game
        each = self.how.states_of_an_episode
        number = ceil(count / each)
        starts, weights = self.starts(random, number)
        orders = self.orders(random, number)
        if self.learned:
            later = steps if game.number > 1 else random.integers(1, steps // 2, number)
            takes_over = np.where(random.random(number) < 0.5, 0, later)
            orders[np.arange(steps) >= takes_over[:, None]] = DECIDES
        least, most = np.log(self.how.prices)
        prices = np.exp(random.uniform(least, most, number))
        after = self.drive(starts, weights, orders, prices).states
        states = np.concatenate([starts[:, None], after[:, :-1]], axis=1)
        finite = np.isfinite(states).all(axis=(1, 2, 3))
        states = states[finite]
        weights = weights[finite]
        away = (
            np.abs(states[:, :, 0, 1] - float(game.scene.target_lane))
            > float(game.scene.lane_width) / 2
        )
        likely = away * states[:, :, 0, 3] / float(game.robot.speed_limit)
        likely = np.clip(likely, self.how.min_likely, 1.0)
        likely /= likely.sum(axis=1, keepdims=True)
        visited = [
            own[random.choice(steps, each, replace=False, p=p)]
            for own, p in zip(states, likely, strict=True)
        ]
        return np.concatenate(visited)[:count], np.repeat(weights, each, axis=0)[:count]


_describe = jax.jit(jax.vmap(describe, (None, 0, 0)))
_rank = jax.jit(jax.vmap(nearness, (None, 0)))
