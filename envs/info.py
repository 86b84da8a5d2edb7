"""List the keys of ``info`` with their meanings, and describe the robot's last step.

The text behind each key is its row in ``notebooks/REFERENCE.md``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, TypedDict

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import DTypeLike

from ms_highway.choice.rule import NOT_ESTIMATED
from ms_highway.loop.controller import ControlStep
from ms_highway.runtime.arrays import ModelProbabilities


@dataclass(frozen=True)
class Timing:
    """Measured times of the robot's step.

    Any two compare equal, so that episodes can be compared without their times.

    Attributes:
        planning_seconds: wall time of the plan, compilation excluded.
        decision_seconds: wall time of choosing the model, compilation excluded; 0
            without a choice.
        compile_seconds: time spent compiling and warming up.
    """

    planning_seconds: float = field(default=0.0, compare=False)
    decision_seconds: float = field(default=0.0, compare=False)
    compile_seconds: float = field(default=0.0, compare=False)

    shape: ClassVar[tuple[int]] = (3,)

    def __array__(
        self,
        dtype: DTypeLike | None = None,
        copy: bool | None = None,
    ) -> np.ndarray:
        """Return the three times as an array [s].

        Recorders such as Minari's store them so.
        """
        return np.array(
            [self.planning_seconds, self.decision_seconds, self.compile_seconds], dtype
        )


class GameInfo(TypedDict):
    """Keys of ``info`` in all environments of the package; the robot is car 0."""

    speed: float
    """Speed of the robot [m/s]."""

    crashed: bool
    """Whether the robot's body overlaps another one after this step."""

    collision: bool
    """Whether the robot collides by the reward's measure, see [Reward](#reward)."""

    collision_effect: str
    """What a collision does: it only costs reward."""

    control: dict[str, float]
    """What the robot did: ``acceleration`` before friction [m/s²], and ``steering`` of
    the front wheels [rad].
    """

    action: object
    """Action that was given; NaN or -1 before the first step."""

    rewards: dict[str, float]
    """Terms of the reward by feature; ``computation`` is -lambda T where the agent
    chooses models.
    """


class PlanInfo(TypedDict):
    """Keys of ``info`` about the robot's plan, where it plans."""

    model: str
    """Model that predicts the human in the plan that drives; of several humans, their
    most expensive one.
    """

    models: tuple[str, ...]
    """Model of every human in the plan that drives."""

    status: str
    """What drives: the step's plan (``planned``); the ``previous plan``, where that
    failed; ``braking``, where both did; the previous plan again, as the new one came
    ``late``; or a ``way out`` from humans who do not yield.
    """

    choice_failed: bool
    """Whether a gain that the rule asked for could not be computed."""

    plan_steps: int
    """Number of steps of the ascent that led to this step's plan; 0 if nothing was
    planned.
    """

    converged: bool
    """Whether the last of these steps hardly moved the plan."""

    timing: Timing
    """``planning_seconds``, ``decision_seconds`` and ``compile_seconds`` of the step
    [s].
    """


class InteractionInfo(TypedDict, total=False):
    """Further keys of ``info`` in an `ms_highway.envs.base.InteractionEnv`.

    ``human_status`` is always there; keys of several humans are there in scenarios with
    streams, and the other keys where the robot plans.
    """

    clocked: bool
    """Whether measured times had a say in the choice, so that the same seed may be
    another episode.
    """

    gains: dict[str, float]
    """Gain per step that the controller expects of each model over the first of the
    ladder, before the price of its time [reward]; the highest over the humans for whom
    it is estimated; of every model of the ladder, -inf where none was estimated; empty
    where no rule chooses.
    """

    counted_seconds: float | None
    """T of the step's plan [s]."""

    human_status: tuple[str | None, ...]
    """Status of each human; None for cars that do not plan."""

    distance_to_cones: float
    """Distance from the robot's front to the first cone ahead in its lane, infinite
    without one [m]; among several humans.
    """

    success: bool
    """Whether the robot is in the target lane and has not collided so far; among
    several humans.
    """

    is_success: bool
    """The same, as stable-baselines3 calls it."""

    humans_idm: int
    """Number of humans that this model predicts, likewise ``humans_turn`` and
    ``humans_tom``; among several humans.
    """

    belief: ModelProbabilities
    """Probability of naive, idm, turn and tom for every human, [humans, 4]; with a
    controller's ``belief``.
    """


def plan_info(step: ControlStep | None, humans: int) -> PlanInfo:
    """Describe the plan of a step, or what stands for it before the first step.

    Args:
        step: of the robot's controller, None before the first.
        humans: their number.
    """
    if step is None:
        return {
            "model": "",
            "models": ("",) * humans,
            "status": "",
            "choice_failed": False,
            "plan_steps": 0,
            "converged": False,
            "timing": Timing(),
        }
    timing = Timing(
        float(step.planning_seconds),
        float(step.decision_seconds),
        float(step.compile_seconds),
    )
    return {
        "model": step.model,
        "models": step.models,
        "status": step.status,
        "choice_failed": step.choice_failed,
        "plan_steps": step.plan_steps,
        "converged": step.converged,
        "timing": timing,
    }


def gains_info(step: ControlStep | None, models: Sequence[str]) -> dict[str, float]:
    """Return the highest gain of each of these models over all humans.

    See `InteractionInfo`.
    """
    gains = dict.fromkeys(models, NOT_ESTIMATED)
    return gains if step is None else gains | step.highest_gains()


def human_status(human: Vehicle) -> str | None:
    """Return the status of a human's last step, see `InteractionInfo`."""
    # highway-env's vehicles take no steps of a controller.
    if not hasattr(human, "last_step"):
        return None
    return human.last_step.status if human.last_step else ""
