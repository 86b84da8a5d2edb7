"""What a controller is, and the record of its steps.

Controllers work at the public boundary: float64 NumPy states and controls in SI units, car 0 is the one that is
driven, car 1 its partner. They are the only stateful objects of the core.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from jaxtyping import Float

from ms_highway.control.fallback import PLANNED, STATUSES, Status, brake, followed
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.planning.human_models import HumanModel, JointPlan

__all__ = ["ControlStep", "Controller", "control_step", "rest_of", "with_stranger"]


@dataclass(frozen=True)
class ControlStep:
    """Record of one step of a controller.

    Attributes:
        control: what to execute now, ``(omega, acceleration)``.
        plan: the controls planned over the horizon, [steps, 2]; fewer where only part of the last plan is left.
        human: the partner's controls that the plan counts on, as many.
        model: name of the human model that planned.
        planning_seconds: wall time of the plan, compilation excluded.
        decision_seconds: wall time of choosing the model, compilation excluded; 0 without a choice.
        compile_seconds: time spent compiling and warming up in this step.
        gains: estimated gain of switching to each model that was considered, by name.
        status: how the control came about.
    """

    control: Float[np.ndarray, "2"]
    plan: Float[np.ndarray, "steps 2"]
    human: Float[np.ndarray, "steps 2"]
    model: str
    planning_seconds: float
    decision_seconds: float = 0.0
    compile_seconds: float = 0.0
    gains: Mapping[str, float] = field(default_factory=dict)
    status: Status = "planned"


class Controller(Protocol):
    """Drives car 0 of a game, one step at a time.

    Attributes:
        game: what is played; it may change between steps, and one of the same shapes compiles nothing.
    """

    game: Game

    def reset(self) -> None:
        """Forget the past, before a new episode."""

    def meet(self) -> None:
        """Forget the partner: from now on, car 1 is another."""

    def step(
        self, state: Float[np.ndarray, "cars 4"], before: Float[np.ndarray, "cars 4"] | None = None
    ) -> ControlStep:
        """Control for the coming step, given all cars now.

        Args:
            state: all cars now.
            before: all cars before the last step, in the coordinates of now, where these have changed since.
        """


def control_step(
    game: Game,
    model: HumanModel,
    plan: JointPlan,
    state: Float[np.ndarray, "cars 4"],
    last: ControlStep | None,
) -> ControlStep:
    """The record of a scaled plan; where the plan is not finite, of what is left of the last one, or of braking."""
    robot, human = (np.asarray(side) * np.asarray(game.planner.control_scale, dtype=float) for side in plan)
    finite = bool(np.isfinite(robot).all() and np.isfinite(human).all())
    left = len(last.plan) if last is not None and last.status != "braking" else 0
    status, _ = followed(finite, left, len(robot))
    if last is not None and STATUSES[status] == "previous plan":
        robot, human = last.plan[1:], last.human[1:]
    elif status != PLANNED:
        robot = brake(game, state[0])
        human = np.tile(keep_velocity(game.dynamics, np.asarray(state, dtype=float)[1]), (len(robot), 1))
    return ControlStep(robot[0], robot, human, model.name, 0.0, status=STATUSES[status])


def rest_of(game: Game, last: ControlStep | None) -> JointPlan | None:
    """Where a warm start begins: the rest of the last plan, scaled, its last control repeated; None without one."""
    if last is None:
        return None
    rest = np.minimum(np.arange(1, game.planner.horizon + 1), len(last.plan) - 1)
    scale = np.asarray(game.planner.control_scale)
    return JointPlan(last.plan[rest] / scale, last.human[rest] / scale)


def with_stranger(last: ControlStep | None) -> ControlStep | None:
    """The last step of a controller that meets another partner: what it expected of the last one says nothing."""
    return last and replace(last, human=np.zeros_like(last.human))
