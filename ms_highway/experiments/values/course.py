"""Courses: what values of computation are learned on."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ms_highway.game.game import Game
from ms_highway.metareasoning.rule import Rule
from ms_highway.simulation.loop import simulate
from ms_highway.simulation.records import Episodes, Loop, Records

__all__ = ["SEGMENT", "Course", "drive", "noisy_starts"]

MOST_NOISE = 4.0  # see `noisy_starts`
SEGMENT = 20  # steps


@dataclass(frozen=True)
class Course:
    """Where values are learned.

    Attributes:
        name: in reports.
        game: that is played.
        draw: draws the start of every car.
        steps: length of an episode.
        rungs: places of the course's own ladder in the ladder that is learned.
        share: of the states that a whole course is given.
    """

    name: str
    game: Game
    draw: Callable[[np.random.Generator], Float[np.ndarray, "cars 4"]]
    steps: int
    rungs: tuple[int, ...]
    share: float = 1.0


def noisy_starts(course: Course, random: np.random.Generator, count: int) -> Float[np.ndarray, "starts cars 4"]:
    """Draw starts with one to five times the noise of the course's own.

    A start is ``a + c (b - a)`` with two draws a and b, which has their mean and ``sqrt(c^2 + (1 - c)^2)`` times their
    standard deviation; c is drawn from 1 to 4.
    """
    pairs = np.array([[course.draw(random), course.draw(random)] for _ in range(count)])
    factors = random.uniform(1.0, MOST_NOISE, (count, 1, 1))
    return (pairs[:, 0] + factors * (pairs[:, 1] - pairs[:, 0])).astype(np.float32)


def drive(
    course: Course,
    rule: Rule,
    starts: Float[np.ndarray, "episodes cars 4"],
    schedules: Int[np.ndarray, "episodes steps"],
    prices: Float[np.ndarray, "episodes"],
    mesh: Mesh,
) -> Records:
    """Simulate a course from these starts, with models by schedule or by the rule, see `Episodes`.

    Whatever their length, episodes are simulated `SEGMENT` steps at a time, so that a course is compiled once. Plans
    start cold, and learned values look at the state alone: nothing else goes over from one segment to the next.
    """
    rewards = course.game.robot, course.game.human
    weights = [np.broadcast_to(np.asarray(r.weights, np.float32), (len(starts), len(r.names))) for r in rewards]
    steps, now, parts = schedules.shape[1], np.asarray(starts, np.float32), []
    for first in range(0, steps, SEGMENT):
        part = np.asarray(schedules[:, first : first + SEGMENT], np.int32)
        part = np.pad(part, ((0, 0), (0, SEGMENT - part.shape[1])), mode="edge")
        episodes = Episodes(now, np.asarray(prices, np.float32), part, *weights)
        parts.append(simulate(Loop(course.game, rule), episodes, mesh))
        now = np.asarray(parts[-1].states[:, -1])
    return Records(*(np.concatenate(columns, axis=1)[:, :steps] for columns in zip(*parts, strict=True)))
