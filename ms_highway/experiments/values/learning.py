"""Learn the value of computation: rollouts and fits, round by round, as cost-sensitive policy iteration.

In the first round, a rollout goes on with one rung; from the second round on, with the rule that was fitted last, and
states are those that this rule comes through. Every number is drawn from its own stream, so that a seed gives the same
values, whether learning was interrupted or not, and on any number of devices.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from ms_highway.experiments.values.course import Course, drive
from ms_highway.experiments.values.fitting import fit, new_network
from ms_highway.experiments.values.kept import keep, read_kept
from ms_highway.experiments.values.rollouts import HORIZON, Rollouts, joined, roll_out, visited
from ms_highway.metareasoning.learned_value import LearnedValue
from ms_highway.metareasoning.values import Values, input_names
from ms_highway.planning.human_models import human_model
from ms_highway.runtime.packing import pack
from ms_highway.simulation.records import DECIDES

__all__ = ["BLIND", "Learning", "Progress", "learn", "rollouts_file"]

BLIND = {"lambda": ("log10 lambda",), "gradients": ("d/d ",)}
"""Parts of the names of inputs that `Learning` can do without, by what it is called."""

LEAST_SPREAD = 1e-3  # of an input
UNSEEN = 1e9  # spread of an input that is left out
HELD_OUT_STARTS = 8
HELD_OUT_PRICES = (0.1, 1.0, 10.0)
SWITCHES = (2, 4, 6, 9, 13, 20)  # steps after which the orders that rules are compared with go over to another rung
EVALUATION, COURSE, HELD_OUT = 0, 1, 2  # streams of random numbers


@dataclass(frozen=True)
class Learning:
    """How values are learned.

    Attributes:
        costs: T(M) by model, cheapest first [s]: the ladder.
        prices: the least and the largest lambda that is learned.
        rounds: of rollouts and fits.
        states: that rollouts start from, on each course, in the first round and in the others.
        horizon: steps of a rollout that count.
        without: names of `BLIND`, for ablations.
        seed: of all random numbers, which have nothing to do with the numbered starts of environments.
        settings: what the file of values tells beside this.
    """

    costs: Mapping[str, float]
    prices: tuple[float, float] = (1e-3, 100.0)
    rounds: int = 5
    states: tuple[int, int] = (400, 250)
    horizon: int = HORIZON
    without: tuple[str, ...] = ()
    seed: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)

    def rule(self, course: Course, values: Values | None) -> LearnedValue:
        """Return the rule on a course's ladder; before any values are learned, one that is not used."""
        names = list(self.costs)
        models = tuple(human_model(names[rung]) for rung in course.rungs)
        costs = np.array([self.costs[model.name] for model in models])
        return (values or self.values([], 0)).rule(models, costs, self.prices[0])

    def values(self, done: Sequence[Rollouts], number: int) -> Values:
        """Fit values to rollouts in round ``number``, from 1."""
        random, inputs, rungs = self.stream(number, EVALUATION), len(input_names()), len(self.costs)
        centre, spread = np.zeros(inputs, np.float32), np.ones(inputs, np.float32)
        network = new_network(random, inputs, rungs)
        if done:
            rollouts = joined(done)
            logarithms = np.log10(self.prices)
            known = rollouts.descriptions
            centre = np.append(known.mean(axis=0), logarithms.mean()).astype(np.float32)
            spread = np.append(known.std(axis=0), np.ptp(logarithms) / np.sqrt(12)).astype(np.float32) + LEAST_SPREAD
            left_out = [part for name in self.without for part in BLIND[name]]
            for place, name in enumerate(input_names()):
                if any(part in name for part in left_out):
                    spread[place] = UNSEEN
            costs = np.array(list(self.costs.values()))
            network = fit(rollouts, costs, self.prices, centre, spread, random)
        provenance = {
            **self.settings,
            "states": sum(len(part.descriptions) for part in done),
            "rounds": number,
            "horizon": self.horizon,
        }
        return Values(network, centre, spread, dict(self.costs), self.prices, input_names(), provenance)

    def stream(self, *place: int) -> np.random.Generator:
        """Return the random numbers of a place, such as a round and the number of a course."""
        return np.random.default_rng([self.seed, *place])


class Progress(NamedTuple):
    """What was done last.

    Attributes:
        round: from 1.
        course: its name; empty after the fit that ends a round.
        values: after a fit.
        regrets: held-out regret per step of each whole course, by its name, after a fit: means over
            `HELD_OUT_STARTS` starts and `HELD_OUT_PRICES`, to the best of simple orders and of the rule itself.
    """

    round: int
    course: str
    values: Values | None
    regrets: dict[str, float]


def learn(learning: Learning, courses: Sequence[Course], kept: Path | None, mesh: Mesh) -> Iterator[Progress]:
    """Learn values on some courses.

    Args:
        learning: how.
        courses: where.
        kept: file that keeps all rollouts, from which an interrupted run goes on; removed by the caller at the end.
        mesh: devices, see `ms_highway.simulation.devices.device_mesh`.

    Yields:
        Progress, after the rollouts of each course and after each fit.

    Raises:
        ValueError: if the file is there and holds something else.
    """
    places = [(course.name, course.steps, course.rungs, _digest(course)) for course in courses]
    about = json.dumps([asdict(learning), places])
    done = {} if kept is None or not kept.exists() else read_kept(kept, about, Rollouts)
    yardsticks = {course.name: _yardstick(learning, course, mesh) for course in courses if course.share == 1}
    values: Values | None = None
    for number in range(1, learning.rounds + 1):
        for place, course in enumerate(courses):
            if (number, place) not in done:
                done[number, place] = _rollouts(learning, course, values, number, place, mesh)
                if kept is not None and (course.share == 1 or place == len(courses) - 1):
                    keep(kept, done, about)
            yield Progress(number, course.name, None, {})
        so_far = [rollouts for (one, _), rollouts in sorted(done.items()) if one <= number]
        values = learning.values(so_far, number)
        regrets = {
            course.name: _regret(learning, course, values, yardsticks[course.name], mesh)
            for course in courses
            if course.name in yardsticks
        }
        yield Progress(number, "", values, regrets)


def _digest(course: Course) -> int:
    """Return a number that tells games apart."""
    return crc32(pack(course.game).numbers.tobytes())


def rollouts_file(out: Path) -> Path:
    """Return the file that keeps the rollouts of values that will be written to ``out``."""
    return out.with_name(f"{out.name}.rollouts.npz")


def _rollouts(
    learning: Learning, course: Course, values: Values | None, number: int, place: int, mesh: Mesh
) -> Rollouts:
    random, rule = learning.stream(number, COURSE, place), learning.rule(course, values)
    count = max(1, round(course.share * learning.states[0 if values is None else 1]))
    states = visited(course, rule, random, count, values is not None, mesh)
    return roll_out(course, rule, states, random, values is not None, len(learning.costs), learning.horizon, mesh)


class _Yardstick(NamedTuple):
    """Held-out starts, and what simple orders earn and plan from them, means over steps."""

    starts: Float[np.ndarray, "starts cars 4"]
    rewards: Float[np.ndarray, "orders starts"]
    seconds: Float[np.ndarray, "orders starts"]


def _yardstick(learning: Learning, course: Course, mesh: Mesh) -> _Yardstick:
    """Try one rung up to some step and another one from there on."""
    random, rule = learning.stream(EVALUATION, HELD_OUT), learning.rule(course, None)
    starts, rungs = np.array([course.draw(random) for _ in range(HELD_OUT_STARTS)], np.float32), range(len(rule.ladder))
    steps = np.arange(course.steps)
    orders = [np.where(steps < end, one, other) for end in SWITCHES for one in rungs for other in rungs if one != other]
    orders += [np.full(course.steps, rung) for rung in rungs]
    schedules = np.repeat(np.array(orders), len(starts), axis=0)
    records = drive(course, rule, np.tile(starts, (len(orders), 1, 1)), schedules, np.ones(len(schedules)), mesh)
    seconds = np.asarray(rule.costs)[records.model].mean(axis=1).reshape(len(orders), -1)
    return _Yardstick(starts, np.mean(records.reward, axis=1).reshape(len(orders), -1), seconds)


def _regret(learning: Learning, course: Course, values: Values, yardstick: _Yardstick, mesh: Mesh) -> float:
    rule, prices = learning.rule(course, values), np.repeat(HELD_OUT_PRICES, HELD_OUT_STARTS)
    starts = np.tile(yardstick.starts, (len(HELD_OUT_PRICES), 1, 1))
    records = drive(course, rule, starts, np.full((len(starts), course.steps), DECIDES), prices, mesh)
    seconds = np.asarray(rule.costs)[records.model].mean(axis=1)
    earned = records.reward.mean(axis=1) - prices * seconds
    known = np.concatenate([(yardstick.rewards - price * yardstick.seconds).max(axis=0) for price in HELD_OUT_PRICES])
    return float(np.mean(np.maximum(known - earned, 0)))
