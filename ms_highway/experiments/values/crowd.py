"""Learn the value of computation per human of a crowd: paired rollouts and fits, round by round.

From a state, the robot drives some steps with one human predicted by a dearer model, and once with a naive prediction:
the difference of what it earns is the gain. In the first round all others are predicted naively, then by the rule that
was fitted last, which also visits the states. Every number is drawn from its own stream: a seed gives the same values,
whether learning was interrupted or not, and on any number of devices.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ms_highway.experiments.values.fitting import BATCH, NETWORKS, SOFTENING, descend, new_network
from ms_highway.experiments.values.kept import keep, read_kept
from ms_highway.game.crowd import Crowd
from ms_highway.metareasoning.crowd.learned import LearnedCrowdValue
from ms_highway.metareasoning.crowd.rule import CrowdCosts
from ms_highway.metareasoning.crowd.situation import describe_humans, human_description_names
from ms_highway.metareasoning.crowd.values import CrowdValues
from ms_highway.metareasoning.learned_value import Network, noise, outputs
from ms_highway.planning.crowd import NAIVE, RUNGS
from ms_highway.simulation.crowd import CrowdEpisodes, CrowdLoop, CrowdRecords, simulate_crowd
from ms_highway.simulation.records import DECIDES

__all__ = ["CrowdCourse", "CrowdLearning", "CrowdProgress", "Gains", "drive_crowd", "learn_crowd"]

HORIZON = 25  # steps of a rollout
STEPS = 3000  # of a fit
STAYS = 0.9  # probability that a random order keeps the rungs for another step
STATES_OF_AN_EPISODE = 6
LEAST_LIKELY = 0.05  # state to be drawn, where driving at the speed limit on the way to the lane counts 1
HUMANS_OF_A_STATE = 3  # whose gains are rolled out
LARGEST_GAIN = 1e3  # per step, where plans fail and cars leave the world
LEAST_SPREAD = 1e-3  # of an input
COURSE, FIT = 1, 2  # streams of random numbers


@dataclass(frozen=True)
class CrowdCourse:
    """Where values are learned.

    Attributes:
        name: in reports.
        crowd: with the rewards that the robot believes.
        draw: draws the start of every car and the weights of the humans' rewards.
        steps: in which an episode is decided; states are drawn from them.
    """

    name: str
    crowd: Crowd
    draw: Callable[[np.random.Generator], tuple[Float[np.ndarray, "cars 4"], Float[np.ndarray, "humans features"]]]
    steps: int


@dataclass(frozen=True)
class CrowdLearning:
    """How values are learned.

    Attributes:
        costs: planning time.
        price: lambda at which the rule visits states and predicts the other humans.
        rounds: of rollouts and fits.
        states: that rollouts start from, on each course and in each round.
        horizon: steps of a rollout.
        seed: of all random numbers, which have nothing to do with the numbered starts of environments.
        settings: what the file of values tells beside this.
    """

    costs: CrowdCosts
    price: float = 30.0
    rounds: int = 2
    states: int = 100
    horizon: int = HORIZON
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)

    def rule(self, values: CrowdValues | None) -> LearnedCrowdValue:
        """Return the rule; before any values are learned, one that is not used."""
        return (values or self.values([], 0)).rule(self.costs, self.price)

    def values(self, done: Sequence["Gains"], number: int) -> CrowdValues:
        """Fit values to gains in round ``number``, from 1."""
        random, names = self.stream(number, FIT), human_description_names()
        centre, spread = np.zeros(len(names), np.float32), np.ones(len(names), np.float32)
        network = new_network(random, len(names), len(RUNGS) - 1)
        if done:
            gains = Gains(*map(np.concatenate, zip(*done, strict=True)))
            centre, spread = gains.descriptions.mean(axis=0), gains.descriptions.std(axis=0) + LEAST_SPREAD
            chosen = random.integers(len(gains.gains), size=(STEPS, NETWORKS, BATCH))
            standard = Gains((gains.descriptions - centre) / spread, gains.gains)
            network = jax.tree.map(np.asarray, _fit(network, standard, chosen))
        provenance = {
            **self.settings,
            "examples": sum(len(part.gains) for part in done),
            "rounds": number,
            "horizon": self.horizon,
            "price": self.price,
        }
        return CrowdValues(network, centre, spread, names, provenance)

    def stream(self, *place: int) -> np.random.Generator:
        """Return the random numbers of a place, such as a round and the number of a course."""
        return np.random.default_rng([self.seed, *place])


class Gains(NamedTuple):
    """What it is worth to think about humans in visited situations.

    Attributes:
        descriptions: see `ms_highway.metareasoning.crowd.situation.describe_humans`.
        gains: of every rung but the first over the first, reward per step.
    """

    descriptions: Float[np.ndarray, "examples numbers"]
    gains: Float[np.ndarray, "examples rungs"]


class CrowdProgress(NamedTuple):
    """What was done last.

    Attributes:
        round: from 1.
        course: whose rollouts were done; empty after the fit that ends a round.
        values: after a fit.
    """

    round: int
    course: str
    values: CrowdValues | None


def learn_crowd(
    learning: CrowdLearning, courses: Sequence[CrowdCourse], kept: Path | None, mesh: Mesh
) -> Iterator[CrowdProgress]:
    """Learn values on some courses.

    Args:
        learning: how.
        courses: where.
        kept: file that keeps all gains, from which an interrupted run goes on; removed by the caller at the end.
        mesh: devices, see `ms_highway.simulation.devices.device_mesh`.

    Yields:
        Progress, after the rollouts of each course and after each fit.

    Raises:
        ValueError: if the file is there and holds something else.
    """
    about = json.dumps([asdict(learning), [course.name for course in courses]], default=np.ndarray.tolist)
    done = {} if kept is None or not kept.exists() else read_kept(kept, about, Gains)
    values: CrowdValues | None = None
    for number in range(1, learning.rounds + 1):
        for place, course in enumerate(courses):
            if (number, place) not in done:
                done[number, place] = _gains(learning, course, values, learning.stream(number, COURSE, place), mesh)
                if kept is not None:
                    keep(kept, done, about)
            yield CrowdProgress(number, course.name, None)
        values = learning.values([gains for (one, _), gains in sorted(done.items()) if one <= number], number)
        yield CrowdProgress(number, "", values)


def _gains(
    learning: CrowdLearning,
    course: CrowdCourse,
    values: CrowdValues | None,
    random: np.random.Generator,
    mesh: Mesh,
) -> Gains:
    """Visit states, choose humans in each, near ones rather, and roll out all rungs for them."""
    rule, humans, rungs = learning.rule(values), course.crowd.humans, len(RUNGS)
    states, weights = _visited(learning, course, rule, random, values is not None, mesh)
    distances = np.linalg.norm(states[:, 1 : 1 + humans, :2] - states[:, :1, :2], axis=-1)
    likely = 1.0 / (1.0 + np.argsort(np.argsort(distances))) ** 2
    keys = random.exponential(size=likely.shape) / likely  # the smallest are a sample without replacement
    chosen = np.argsort(keys, axis=1)[:, :HUMANS_OF_A_STATE]
    others = NAIVE if values is None else DECIDES
    alone, each = values is None, chosen.shape[1]  # without a rule, all naive is the same for every human
    orders = np.full((len(states), each, rungs, humans), others, np.int32)
    for rung in range(rungs):
        np.put_along_axis(orders[:, :, rung], chosen[..., None], rung, axis=-1)
    wanted = np.ones((len(states), each, rungs), bool)
    wanted[:, 1:, NAIVE] = not alone
    which = np.nonzero(wanted)[0]
    schedules = np.repeat(orders[wanted][:, None], learning.horizon, axis=1)
    records = drive_crowd(course, rule, states[which], weights[which], schedules, mesh)
    earned = np.full(wanted.shape, np.nan)
    earned[wanted] = np.clip(np.nan_to_num(records.reward, nan=-LARGEST_GAIN), -LARGEST_GAIN, None).mean(axis=1)
    if alone:
        earned[:, 1:, NAIVE] = earned[:, :1, NAIVE]
    described = np.asarray(_describe(course.crowd, states))[np.arange(len(states))[:, None], chosen]
    gains = (earned[..., 1:] - earned[..., :1]).astype(np.float32)
    return Gains(described.reshape(-1, described.shape[-1]), gains.reshape(-1, rungs - 1))


_describe = jax.jit(jax.vmap(describe_humans, in_axes=(None, 0)))


def _visited(
    learning: CrowdLearning,
    course: CrowdCourse,
    rule: LearnedCrowdValue,
    random: np.random.Generator,
    learned: bool,
    mesh: Mesh,
) -> tuple[Float[np.ndarray, "states cars 4"], Float[np.ndarray, "states humans features"]]:
    """Draw states that episodes come through, predicted by random orders; in half of them by a learned rule.

    Most are of robots that drive and have not reached their lane: measured in Dense Merge, predictions hardly matter
    in others, which are three of four.
    """
    count = -(-learning.states // STATES_OF_AN_EPISODE)
    drawn = [course.draw(random) for _ in range(count)]
    starts, weights = (np.asarray(part, np.float32) for part in zip(*drawn, strict=True))
    orders = _random_orders(random, count, course.steps, course.crowd.humans)
    if learned:
        orders[::2] = DECIDES
    after = drive_crowd(course, rule, starts, weights, orders, mesh, learning.horizon).states
    states = np.concatenate([starts[:, None], after[:, :-1]], axis=1)
    finite = np.isfinite(states).all(axis=(1, 2, 3))
    states, weights = states[finite], weights[finite]
    scene, y, speed = course.crowd.game.scene, states[:, :, 0, 1], states[:, :, 0, 3]
    away = np.abs(y - float(scene.target_lane)) > float(scene.lane_width) / 2
    likely = np.maximum(away * speed / float(course.crowd.game.robot.speed_limit), LEAST_LIKELY)
    shares = likely / likely.sum(axis=1, keepdims=True)
    places = np.array([random.choice(course.steps, STATES_OF_AN_EPISODE, replace=False, p=share) for share in shares])
    visited = states[np.arange(len(states))[:, None], places].reshape(-1, *states.shape[2:])
    return visited[: learning.states], np.repeat(weights, STATES_OF_AN_EPISODE, axis=0)[: learning.states]


def _random_orders(
    random: np.random.Generator, count: int, steps: int, humans: int
) -> Int[np.ndarray, "count steps humans"]:
    """Draw orders that keep their rungs for some steps, with frequencies that differ from order to order."""
    orders = np.zeros((count, steps, humans), np.int32)
    for order, share in zip(orders, random.dirichlet(np.ones(len(RUNGS)), count), strict=True):
        for step in range(steps):
            keeps = step > 0 and random.random() < STAYS
            order[step] = order[step - 1] if keeps else random.choice(len(RUNGS), humans, p=share)
    return orders


def drive_crowd(
    course: CrowdCourse,
    rule: LearnedCrowdValue,
    starts: Float[np.ndarray, "episodes cars 4"],
    weights: Float[np.ndarray, "episodes humans features"],
    schedules: Int[np.ndarray, "episodes steps humans"],
    mesh: Mesh,
    segment: int | None = None,
) -> CrowdRecords:
    """Simulate a course from these starts, with rungs by schedule or by the rule.

    With a ``segment``, so many steps at a time, so that all lengths are compiled once; every segment starts cold.
    """
    steps, now, parts = schedules.shape[1], starts, []
    length = steps if segment is None else segment
    for first in range(0, steps, length):
        part = np.asarray(schedules[:, first : first + length], np.int32)
        part = np.pad(part, ((0, 0), (0, length - part.shape[1]), (0, 0)), mode="edge")
        seeds = np.arange(len(now), dtype=np.int32)
        parts.append(simulate_crowd(CrowdLoop(course.crowd, rule), CrowdEpisodes(now, weights, seeds, part), mesh))
        now = np.asarray(parts[-1].states[:, -1])
    return CrowdRecords(*(np.concatenate(columns, axis=1)[:, :steps] for columns in zip(*parts, strict=True)))


@jax.jit
def _fit(network: Network, gains: Gains, chosen: Int[jax.Array, "steps networks batch"]) -> Network:
    """Fit gains and their spread, by the likelihood of normal errors, see `ms_highway.experiments.values.fitting`."""

    def one(network: Network, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        means, spreads = outputs(jax.tree.map(lambda part: part[None], network), inputs)
        return means[0], noise(spreads[0])

    def loss(network: Network, chosen: Int[jax.Array, "networks batch"]) -> Float[jax.Array, ""]:
        inputs, targets = (jnp.asarray(part)[chosen] for part in gains)
        means, apart = jax.vmap(jax.vmap(one, in_axes=(None, 0)))(network, inputs)
        surprise = (means - targets) ** 2 / (2 * apart**2) + jnp.log(apart)
        surprise *= jax.lax.stop_gradient(apart) ** SOFTENING
        return surprise.sum(axis=-1).mean(axis=-1).sum()

    return descend(loss, network, (chosen,))
