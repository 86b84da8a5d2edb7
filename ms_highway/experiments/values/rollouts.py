"""Roll out every model from visited situations: what the value of computation is learned from."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ms_highway.experiments.values.course import SEGMENT, Course, drive, noisy_starts
from ms_highway.metareasoning.learned_value import LearnedValue
from ms_highway.metareasoning.situation import describe
from ms_highway.runtime.arrays import Array
from ms_highway.simulation.records import DECIDES

__all__ = ["HORIZON", "Rollouts", "draw_prices", "joined", "roll_out", "visited"]

HORIZON = SEGMENT  # steps of a rollout
STAYS = 0.8  # probability that a random order keeps its rung for another step
WORST = 1e6  # of a rollout, where plans fail and cars leave the world
STRATA = 2  # of the prices that the rule is followed at, in their logarithm: one from each


class Rollouts(NamedTuple):
    """What was earned and planned from states, by the rung of the first step and what was followed afterwards.

    A way to go on that one does not have has a reward of -inf, and so have rungs that are not on the course's ladder.

    Attributes:
        descriptions: of the states, see `ms_highway.metareasoning.situation.describe`.
        rewards: sums over the rollout.
        seconds: of planning at T(M), sums over the rollout.
    """

    descriptions: Float[Array, "*states numbers"]
    rewards: Float[Array, "*states rungs ways"]
    seconds: Float[Array, "*states rungs ways"]

    def best(self, prices: Float[Array, "*states"]) -> Float[Array, "*states rungs"]:
        """Return the reward less lambda times the seconds of the best way to go on after each rung."""
        return (self.rewards - prices[..., None, None] * self.seconds).max(axis=-1)


def joined(parts: Sequence[Rollouts]) -> Rollouts:
    """Return the rollouts of all parts."""
    most = max(part.rewards.shape[-1] for part in parts)

    def padded(array: Float[Array, "states rungs ways"], value: float) -> Float[np.ndarray, "states rungs ways"]:
        return np.pad(array, ((0, 0), (0, 0), (0, most - array.shape[-1])), constant_values=value)

    return Rollouts(
        np.concatenate([part.descriptions for part in parts]),
        np.concatenate([padded(part.rewards, -np.inf) for part in parts]),
        np.concatenate([padded(part.seconds, 0.0) for part in parts]),
    )


def draw_prices(random: np.random.Generator, prices: tuple[float, float], count: int) -> Float[np.ndarray, "count"]:
    """Draw lambdas whose logarithms are uniform."""
    return np.exp(random.uniform(np.log(prices[0]), np.log(prices[1]), count)).astype(np.float32)


def visited(
    course: Course, rule: LearnedValue, random: np.random.Generator, count: int, learned: bool, mesh: Mesh
) -> Float[np.ndarray, "states cars 4"]:
    """Draw states that episodes come through, planned by random orders.

    Once the rule is learned, it takes over: at the first step in half of the episodes, later in the others.
    """
    episodes = -(-count // 4)  # four states of each
    starts = noisy_starts(course, random, episodes)
    schedules = _random_orders(random, episodes, course.steps, len(rule.ladder))
    if learned:
        takes_over = np.where(random.random(episodes) < 0.5, 0, random.integers(1, course.steps // 2, episodes))
        schedules[np.arange(course.steps) >= takes_over[:, None]] = DECIDES
    prices = draw_prices(random, tuple(np.asarray(rule.prices)), episodes)
    after = drive(course, rule, starts, schedules, prices, mesh).states
    states = np.concatenate([starts[:, None], after[:, :-1]], axis=1)
    states = states[np.isfinite(states).all(axis=(1, 2, 3))]
    places = np.array([random.choice(course.steps, 4, replace=False) for _ in states])
    return states[np.arange(len(states))[:, None], places].reshape(-1, *states.shape[2:])[:count]


def _random_orders(random: np.random.Generator, count: int, steps: int, rungs: int) -> Int[np.ndarray, "count steps"]:
    """Draw orders that keep a rung for some steps, with frequencies of the rungs that differ from order to order."""
    orders = np.zeros((count, steps), np.int32)
    shares = random.dirichlet(np.ones(rungs), count)
    for order, share in zip(orders, shares, strict=True):
        changes = random.random(steps) > STAYS
        drawn = random.choice(rungs, steps, p=share)
        for step in range(steps):
            order[step] = drawn[step] if step == 0 or changes[step] else order[step - 1]
    return orders


_describe = jax.jit(jax.vmap(describe, in_axes=(None, 0)))


def roll_out(
    course: Course,
    rule: LearnedValue,
    states: Float[np.ndarray, "states cars 4"],
    random: np.random.Generator,
    learned: bool,
    rungs: int,
    horizon: int,
    mesh: Mesh,
) -> Rollouts:
    """Plan one step with each rung; go on with each rung, or once the rule is learned, by the rule or with the top.

    Args:
        course: where.
        rule: on the course's ladder.
        states: to start from.
        random: draws the prices that the rule is followed at.
        learned: whether the rule is.
        rungs: of the ladder that is learned, of which the course's may be a part.
        horizon: number of steps that count.
        mesh: devices.
    """
    own = len(rule.ladder)
    ways: list[tuple[int, np.ndarray]] = []  # rung from the second step on, or DECIDES, and prices
    if not learned:
        ways = [(rung, np.ones(len(states), np.float32)) for rung in range(own)]
    else:
        least, largest = np.asarray(rule.prices, float)
        edges = pairwise(np.geomspace(least, largest, STRATA + 1).tolist())
        ways = [(DECIDES, draw_prices(random, pair, len(states))) for pair in edges]
        ways.append((own - 1, np.ones(len(states), np.float32)))
    first = np.repeat(np.arange(own), len(ways))
    then = np.tile([rung for rung, _ in ways], own)
    schedules = np.where(np.arange(HORIZON) == 0, first[:, None], then[:, None])  # [own * ways, steps]
    prices = np.stack([price for _, price in ways], axis=1)  # [states, ways]
    many = len(schedules)
    records = drive(
        course,
        rule,
        np.repeat(states, many, axis=0),
        np.tile(schedules, (len(states), 1)),
        np.tile(prices, (1, own)).ravel(),
        mesh,
    )
    shape = len(states), own, len(ways)
    earned = np.sum(records.reward[:, :horizon], axis=1, dtype=float)
    planned = np.sum(np.asarray(rule.costs, float)[records.model[:, :horizon]], axis=1)
    rewards = np.full((len(states), rungs, len(ways)), -np.inf)
    seconds = np.zeros_like(rewards)
    rewards[:, course.rungs] = np.clip(np.nan_to_num(earned, nan=-WORST), -WORST, WORST).reshape(shape)
    seconds[:, course.rungs] = planned.reshape(shape)
    return Rollouts(np.asarray(_describe(course.game, states)), rewards, seconds)
