"""Roll out every model from visited situations: what the value of computation is learned from."""

from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ms_highway.experiments.values.course import Course, drive, noisy_starts
from ms_highway.metareasoning.learned_value import LearnedValue
from ms_highway.metareasoning.situation import describe
from ms_highway.simulation.records import DECIDES

__all__ = ["HORIZON", "Rollouts", "draw_prices", "roll_out", "visited"]

HORIZON = 20  # steps of a rollout
STAYS = 0.8  # probability that a random order keeps its rung for another step
DRAWN = 3  # prices that the rule is followed at from each state


class Rollouts(NamedTuple):
    """What was earned and planned from states, by the rung of the first step and what was followed afterwards.

    A way to go on that one does not have has a reward of -inf, and so have rungs that are not on the course's ladder.

    Attributes:
        descriptions: of the states, see `ms_highway.metareasoning.situation.describe`.
        rewards: sums over the rollout.
        seconds: of planning at T(M), sums over the rollout.
    """

    descriptions: Float[np.ndarray, "states numbers"]
    rewards: Float[np.ndarray, "states rungs ways"]
    seconds: Float[np.ndarray, "states rungs ways"]

    def best(self, prices: Float[np.ndarray, "states"]) -> Float[np.ndarray, "states rungs"]:
        """Return the reward less lambda times the seconds of the best way to go on after each rung."""
        return (self.rewards - prices[:, None, None] * self.seconds).max(axis=-1)


def draw_prices(random: np.random.Generator, prices: tuple[float, float], count: int) -> Float[np.ndarray, "count"]:
    """Draw lambdas whose logarithms are uniform."""
    return np.exp(random.uniform(*np.log(prices), count)).astype(np.float32)


def visited(
    course: Course, rule: LearnedValue, random: np.random.Generator, count: int, learned: bool, mesh: Mesh
) -> Float[np.ndarray, "states cars 4"]:
    """Draw states that episodes come through: half are planned by random orders, half by the rule if it is learned."""
    episodes = -(-count // 4)  # four states of each
    starts = noisy_starts(course, random, episodes)
    schedules = _random_orders(random, episodes, course.steps, len(rule.ladder))
    if learned:
        schedules[::2] = DECIDES
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
    mesh: Mesh,
) -> Rollouts:
    """Plan one step with each rung, and go on with each rung, or by the rule once it is learned, at several prices."""
    own = len(rule.ladder)
    ways: list[tuple[int, np.ndarray]] = []  # rung from the second step on, or DECIDES, and prices
    if not learned:
        ways = [(rung, np.ones(len(states), np.float32)) for rung in range(own)]
    else:
        ways = [(DECIDES, draw_prices(random, tuple(np.asarray(rule.prices)), len(states))) for _ in range(DRAWN)]
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
    costs = np.asarray(rule.costs, float)
    rewards = np.full((len(states), rungs, len(ways)), -np.inf)
    seconds = np.zeros_like(rewards)
    rewards[:, course.rungs] = np.sum(records.reward, axis=1, dtype=float).reshape(shape)
    seconds[:, course.rungs] = np.sum(costs[records.model], axis=1).reshape(shape)
    return Rollouts(np.asarray(_describe(course.game, states)), np.nan_to_num(rewards, nan=-np.inf), seconds)
