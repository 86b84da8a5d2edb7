"""Compare what each plan predicts of the human with what the human does.

A plan rests on a prediction of the human. Here the robot executes all of a plan, without looking up, among humans who
drive as they do in the environments: they see every step, and replan. What they do is compared with what the plan
counted on. All numbers are in SI units.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.control.fixed import FixedModel
from ms_highway.game.dynamics import Dynamics, keep_velocity, step
from ms_highway.game.features import reward
from ms_highway.game.game import Game, swap_roles
from ms_highway.planning.compiled_plans import checked_state
from ms_highway.planning.human_models import HumanModel, Naive

__all__ = ["PlanOutcome", "follow_plan"]

_rewards = jax.jit(reward)


@dataclass(frozen=True)
class PlanOutcome:
    """A plan of K steps under one human model, as it was meant and as it turns out.

    Attributes:
        model: name of the human model.
        time_step: between two states [s].
        expected: ``(x, y, heading, speed)`` of all cars, the robot first, the human second, now and after each step, as
            the plan counts on.
        actual: the same, as it turns out.
        expected_reward: the robot's r_R after each step, if all goes as expected.
        actual_reward: r_R after each step, as it turns out.
    """

    model: str
    time_step: float
    expected: Float[np.ndarray, "times cars 4"]
    actual: Float[np.ndarray, "times cars 4"]
    expected_reward: Float[np.ndarray, "steps"]
    actual_reward: Float[np.ndarray, "steps"]

    @property
    def seconds(self) -> float:
        """How far the plan looks ahead."""
        return self.time_step * len(self.expected_reward)

    @property
    def expected_acceleration(self) -> float:
        """The human's mean acceleration that the plan counts on [m/s^2]."""
        return float(self.expected[-1, 1, 3] - self.expected[0, 1, 3]) / self.seconds

    @property
    def actual_acceleration(self) -> float:
        """The human's mean acceleration, as it turns out [m/s^2]."""
        return float(self.actual[-1, 1, 3] - self.actual[0, 1, 3]) / self.seconds

    @property
    def error(self) -> float:
        """Distance between where the plan expects the human in the end, and where it is [m]."""
        return float(np.linalg.norm(self.expected[-1, 1, :2] - self.actual[-1, 1, :2]))


def follow_plan(game: Game, ladder: Sequence[HumanModel], states: Float[np.ndarray, "cars 4"]) -> list[PlanOutcome]:
    """Compute what comes of the robot's plan under every model, in the same situation.

    Args:
        game: what is played; the human drives for its own reward in it, and believes that the robot keeps its velocity.
        ladder: the human models.
        states: all cars now, in SI units: ``game`` and ``car_states`` of an environment make a situation.

    Raises:
        ValueError: if the states are not a finite array [cars, 4] of two cars or more.
    """
    checked_state(states)
    return [_foresee(game, model, np.asarray(states, dtype=float)) for model in ladder]


def _foresee(game: Game, model: HumanModel, states: Float[np.ndarray, "cars 4"]) -> PlanOutcome:
    planned = FixedModel(game, model).step(states)
    human = FixedModel(swap_roles(game), Naive())
    plans, world = (jax.tree.map(float, dynamics) for dynamics in (game.dynamics, game.world))
    expected, actual = [states], [states]
    for robot, predicted in zip(planned.plan, planned.human, strict=True):
        now = actual[-1]
        drives = human.step(np.concatenate([now[1::-1], now[2:]])).control
        expected.append(_moved(plans, expected[-1], robot, predicted))
        actual.append(_moved(world, now, robot, drives))
    earned = (_earned(game, cars) for cars in (expected, actual))
    return PlanOutcome(model.name, world.time_step, np.array(expected), np.array(actual), *earned)


def _moved(
    dynamics: Dynamics,
    states: Float[np.ndarray, "cars 4"],
    robot: Float[np.ndarray, "2"],
    human: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "cars 4"]:
    """Return all cars a step later; those that nobody drives keep their velocity."""
    controls = np.concatenate([[robot, human], keep_velocity(dynamics, states[2:])])
    return step(dynamics, states, controls)


def _earned(game: Game, states: list[Float[np.ndarray, "cars 4"]]) -> Float[np.ndarray, "steps"]:
    """r_R after each step."""
    return np.asarray(_rewards(game.scene, game.robot, np.array(states[1:], dtype=np.float32)), dtype=float)
