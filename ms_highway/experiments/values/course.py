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

__all__ = ["Course", "drive", "noisy_starts"]

MOST_NOISE = 4.0  # see `noisy_starts`


@dataclass(frozen=True)
class Course:
    """Where values are learned.

    Attributes:
        name: in reports.
        game: that is played.
        draw: draws the start of every car.
        steps: length of an episode.
        rungs: places of the course's own ladder in the ladder that is learned.
    """

    name: str
    game: Game
    draw: Callable[[np.random.Generator], Float[np.ndarray, "cars 4"]]
    steps: int
    rungs: tuple[int, ...]


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
    """Simulate a course from these starts, with models by schedule or by the rule, see `Episodes`."""
    weights = (np.asarray(reward.weights, np.float32) for reward in (course.game.robot, course.game.human))
    episodes = Episodes(
        np.asarray(starts, np.float32),
        np.asarray(prices, np.float32),
        np.asarray(schedules, np.int32),
        *(np.broadcast_to(row, (len(starts), len(row))) for row in weights),
    )
    return simulate(Loop(course.game, rule), episodes, mesh)
