"""Roll out the models of a ladder from visited states.

The value of computation is learned from these examples. In a rollout, a model predicts
one or more of the nearest humans for some steps, and naive predicts the others. Then
naive predicts all of them, or the learned rule chooses.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from math import ceil
from typing import ClassVar, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Float, Int

from ms_highway.choice.choosers import PriceTogether
from ms_highway.choice.rule import GameEvidence, Rule
from ms_highway.choice.situation import describe, distance_rank
from ms_highway.experiments.batch import Batch
from ms_highway.loop.batch import simulate
from ms_highway.loop.records import DECIDES, HUMAN_PLANS, Episodes, Records
from ms_highway.runtime.compilation import Devices

Random: TypeAlias = np.random.Generator

Starts: TypeAlias = Float[np.ndarray, "episodes cars 4"]
"""States of all cars from which episodes or rollouts start."""

DrawnWeights: TypeAlias = Float[np.ndarray, "episodes humans features"]
"""Weights of the rewards that the humans drive for."""

Schedules: TypeAlias = Int[np.ndarray, "episodes steps humans"]
"""Rung of the model that predicts each human in each step."""


class Rollouts(NamedTuple):
    """Gains of the rungs in visited states, an example for each of the nearest humans.

    Attributes:
        descriptions: descriptions of the situations [examples, numbers], see
            `ms_highway.choice.situation`.
        gains: gain per step if a rung, instead of the first one, predicts a human,
            while this rung predicts all nearer humans [examples, rungs - 1]; -inf if
            the rung is not on the scenario's ladder.
    """

    descriptions: Float[np.ndarray, "examples numbers"]
    gains: Float[np.ndarray, "examples rungs"]


@dataclass(frozen=True)
class LearningSettings:
    """Settings of learning.

    The defaults are for one human; `for_several_humans` has those for several.

    Attributes:
        costs: T(M) of the models of the ladder, cheapest first [s].
        prices: least and largest lambda at which the rule drives to the states from
            which rollouts start.
        rounds: number of rounds of rollouts and fits.
        states: number of states from which rollouts start, in each scenario, in the
            first round and in each later one.
        horizon: number of steps of a rollout.
        held: number of these steps with the rung whose gain is learned.
        noise: largest c of `RolloutSimulator.starts`.
        states_of_an_episode: number of states that are drawn from an episode.
        stays: probability that a random order keeps its rungs for another step.
        min_likely: least weight with which a state is drawn; at the speed limit outside
            the target lane, it is 1.
        seed: seed of all random numbers, which are independent of the seeds of
            environments.
        settings: further entries of the provenance of the values.
    """

    for_several_humans: ClassVar[Mapping] = {
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
    """Settings of learning among several humans, where others differ."""

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


@dataclass(frozen=True)
class RolloutSimulator:
    """A scenario in which values are learned, and the rule that drives in it.

    Attributes:
        batch: draws and simulates the episodes of the scenario.
        settings: of learning.
        rule: rule of the last fit, on the scenario's ladder.
        learned: whether there was a fit; otherwise, the rule is not used.
        devices: that simulate it; None for the first.
        worst_step: largest loss that counts in a step, as plans may fail and cars may
            leave the world.
    """

    worst_step: ClassVar[float] = 1e3

    batch: Batch
    settings: LearningSettings
    rule: Rule[GameEvidence]
    learned: bool
    devices: Devices | None

    def starts(self, random: Random, count: int) -> tuple[Starts, DrawnWeights]:
        """Draw starts and the weights of the humans' rewards.

        A start is ``a + c (b - a)`` with two draws a and b, and with c drawn from 1 to
        `LearningSettings.noise`. It has the mean of the draws, and their standard
        deviation times ``sqrt(c^2 + (1 - c)^2)``.
        """
        environment = self.batch.environment
        drawn = [environment.draw_episode(random) for _ in range(2 * count)]
        drawn_starts, drawn_weights = zip(*drawn, strict=True)
        starts = np.array(drawn_starts, np.float32)  # [2 * episodes, cars, 4]
        weights = np.array(drawn_weights, np.float32)  # [2 * episodes, humans, ...]

        # Starts come in pairs a, b; the weights are those of a.
        a = starts[::2]
        b = starts[1::2]
        c = random.uniform(1.0, self.settings.noise, (count, 1, 1))
        c = c.astype(np.float32)
        return a + c * (b - a), weights[::2]

    def orders(self, random: Random, count: int) -> Schedules:
        """Draw orders of models that keep their rungs for some steps.

        Each order has frequencies of rungs of its own. Several humans change their
        rungs in the same steps, each to a rung of its own.
        """
        rungs = len(self.batch.rungs)
        steps = self.batch.steps
        orders = np.zeros((count, steps, self.batch.humans), np.int32)
        frequencies = random.dirichlet(np.ones(rungs), count)  # [episodes, rungs]
        for order, probabilities in zip(orders, frequencies, strict=True):
            drawn = random.choice(rungs, order.shape, p=probabilities)
            changes = random.random(steps) > self.settings.stays
            # Each step takes the rungs that were drawn at the last change.
            step_of_change = np.where(changes, np.arange(steps), 0)
            last_change = np.maximum.accumulate(step_of_change)
            order[:] = drawn[last_change]
        return orders

    def drive(
        self,
        starts: Starts,
        weights: DrawnWeights,
        schedules: Schedules,
        prices: float | Float[np.ndarray, "episodes"],
    ) -> Records:
        """Simulate episodes with models from schedules or from the rule.

        Episodes of any length are simulated in segments as long as a rollout, so that a
        scenario is compiled once. Every segment starts without a last plan.

        Args:
            starts: starts of all cars.
            weights: weights of the humans' rewards.
            schedules: rung of every human, or `DECIDES` for the rule's choice.
            prices: lambdas of the episodes, or one for all.
        """
        loop = replace(self.batch.loop, rule=self.rule)
        count, steps, humans = schedules.shape

        # What all segments have in common.
        lambdas = np.full(count, prices, np.float32)
        robot_weights = np.asarray(loop.game.robot.weights, np.float32)
        robot = np.tile(robot_weights, (count, 1))
        drivers = np.full((count, humans), HUMAN_PLANS)

        # Cut the schedules into segments; repeat the last step until the last one is
        # whole.
        horizon = self.settings.horizon
        steps_of_segments = steps + -steps % horizon
        indices = np.minimum(np.arange(steps_of_segments), steps - 1)
        repeated = schedules[:, indices].astype(np.int32)
        segments = np.split(repeated, steps_of_segments // horizon, axis=1)

        # Drive segment by segment, each from where the last one has ended.
        records = []
        for segment in segments:
            episodes = Episodes(starts, lambdas, segment, robot, weights, drivers)
            records.append(simulate(loop, episodes, self.devices))
            starts = np.asarray(records[-1].states[:, -1])
        return jax.tree.map(
            lambda *parts: np.concatenate(parts, axis=1)[:, :steps], *records
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
        ranks = np.asarray(_rank(game, states))  # [states, humans], 0 is the nearest
        max_humans = min(PriceTogether.most_humans, self.batch.humans)
        earned = self._earned(states, weights, ranks, max_humans)

        # What each further human adds to the reward: [states, rungs, humans].
        with_naive, with_rungs = np.split(earned, [1], axis=1)
        with_rungs = with_rungs.reshape(len(states), -1, max_humans)
        rungs_above = with_rungs.shape[1]
        shape = (len(states), rungs_above, 1)
        with_none = np.broadcast_to(with_naive[:, None], shape)
        by_humans = np.concatenate([with_none, with_rungs], axis=2)
        added = np.diff(by_humans, axis=2)

        # An example for each state and human; -inf for models off the ladder.
        examples = len(states) * max_humans
        added_by_example = np.swapaxes(added, 1, 2).reshape(examples, -1)
        models = list(self.settings.costs)
        columns = [models.index(name) - 1 for name in self.batch.rungs[1:]]
        gains = np.full((examples, len(models) - 1), -np.inf)
        gains[:, np.array(columns, int)] = added_by_example

        nearest = np.argsort(ranks, axis=1)[:, :max_humans]
        descriptions = np.asarray(_describe(game, states, nearest))
        return Rollouts(descriptions.reshape(examples, -1), gains)

    def _earned(
        self,
        states: Starts,
        weights: DrawnWeights,
        ranks: Int[np.ndarray, "states humans"],
        max_humans: int,
    ) -> Float[np.ndarray, "states rollouts"]:
        """Return what the robot earns in the rollouts of each state.

        The reward is summed over a rollout and divided by the steps in which the rung
        predicts the humans. In the first rollout, naive predicts all humans; in the
        others, a rung predicts 1, 2, ... of the nearest humans.

        Args:
            states: where rollouts start.
            weights: weights of the humans' rewards.
            ranks: place of every human among the nearest ones.
            max_humans: largest number of humans that a rung predicts.
        """
        horizon = self.settings.horizon
        humans = self.batch.humans

        # The rollouts from each state: a rung, and how many humans it predicts.
        rungs = range(1, len(self.batch.rungs))
        counts = range(1, max_humans + 1)
        rollouts = [(0, 0), *product(rungs, counts)]

        # Who predicts each human: first the rung or naive, then the rule or naive.
        rung_steps = min(self.settings.held, horizon)
        later = DECIDES if self.learned else 0
        shape = (len(states), len(rollouts), horizon, humans)
        schedules = np.full(shape, later, np.int32)
        for index, (rung, count) in enumerate(rollouts):
            first = np.where(ranks < count, rung, 0)  # [states, humans]
            schedules[:, index, :rung_steps] = first[:, None]

        geometric_mean = float(np.sqrt(np.prod(self.settings.prices)))
        records = self.drive(
            np.repeat(states, len(rollouts), axis=0),
            np.repeat(weights, len(rollouts), axis=0),
            schedules.reshape(-1, horizon, humans),
            prices=geometric_mean,
        )
        rewards = np.nan_to_num(records.reward, nan=-self.worst_step)
        rewards = np.clip(rewards, -self.worst_step, None)
        totals = rewards.sum(axis=1, dtype=float)
        return totals.reshape(len(states), -1) / rung_steps

    def _visited(self, random: Random, count: int) -> tuple[Starts, DrawnWeights]:
        """Draw states from episodes of random orders and the rule.

        After a fit, the rule chooses in half of the episodes and, with one human, in
        the later part of the others. With several humans, states in which the robot
        drives and is not in its lane yet are drawn more often, as predictions hardly
        matter in the others.

        Returns:
            The states, and the weights of the humans' rewards in each.
        """
        steps = self.batch.steps
        game = self.batch.loop.game
        states_of_each = self.settings.states_of_an_episode
        episodes = ceil(count / states_of_each)
        starts, weights = self.starts(random, episodes)

        # Who chooses the models: random orders and, after a fit, the rule.
        orders = self.orders(random, episodes)
        if self.learned:
            if game.number > 1:
                later = np.full(episodes, steps)
            else:
                later = random.integers(1, steps // 2, episodes)
            from_the_start = random.random(episodes) < 0.5
            first_step = np.where(from_the_start, 0, later)
            rule_decides = np.arange(steps) >= first_step[:, None]
            orders[rule_decides] = DECIDES
        lowest, highest = np.log(self.settings.prices)
        prices = np.exp(random.uniform(lowest, highest, episodes))

        # The states before each step, without episodes that fail.
        records = self.drive(starts, weights, orders, prices)
        before_others = records.states[:, :-1]
        states = np.concatenate([starts[:, None], before_others], axis=1)
        finite = np.isfinite(states).all(axis=(1, 2, 3))
        states = states[finite]
        weights = weights[finite]

        drawn = []
        for episode, probabilities in zip(states, self._likely(states), strict=True):
            chosen = random.choice(
                steps,
                states_of_each,
                replace=False,
                p=probabilities,
            )
            drawn.append(episode[chosen])
        weights_of_each = np.repeat(weights, states_of_each, axis=0)
        return np.concatenate(drawn)[:count], weights_of_each[:count]

    def _likely(
        self,
        states: Float[np.ndarray, "episodes steps cars 4"],
    ) -> Float[np.ndarray, "episodes steps"]:
        """Return the probability with which each state of an episode is drawn.

        It grows with the speed of a robot outside its lane.
        """
        game = self.batch.loop.game
        y = states[:, :, 0, 1]
        speed = states[:, :, 0, 3]
        offset = np.abs(y - float(game.scene.target_lane))
        outside_lane = offset > float(game.scene.lane_width) / 2
        likely = outside_lane * speed / float(game.robot.speed_limit)
        likely = np.clip(likely, self.settings.min_likely, 1.0)
        likely /= likely.sum(axis=1, keepdims=True)
        return likely


_describe = jax.jit(jax.vmap(describe, (None, 0, 0)))
_rank = jax.jit(jax.vmap(distance_rank, (None, 0)))
