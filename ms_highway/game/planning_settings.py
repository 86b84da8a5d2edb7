"""Choose the number and size of gradient steps for a horizon and a time step."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jax import numpy as jnp

from ms_highway.runtime.arrays import Scalar

MAX_ITERATIONS = 5000
"""Upper bound on the gradient steps of a plan; more take seconds."""

PAPER_STEPS = 20, 0.03  # number and size
STEP_SHARE = 0.6
"""Share of the `longest_step` that is taken where it is shorter than the wanted one."""

STEEPEST = 1000.0  # the largest weight on a squared lateral distance in the paper's scenes [1 / length unit^2]
SPEED = 0.6  # the paper's speed limit [length units per second]


@dataclass(frozen=True)
class PlanningSettings:
    """Horizon, time step and gradient steps of the plans of robot and human alike.

    They belong together: the reward's curvature in the controls grows with the fourth power of the horizon, and a
    gradient step longer than `longest_step` overshoots. At K = 10 the paper's step size of 0.03 makes theory of mind
    earn -9 in Merger, where 60 steps of 0.01 earn 6.4. What is None is chosen by `gradient_steps`.

    Attributes:
        horizon: number of planned controls, K.
        time_step: of plans and world [s].
        iterations: number of gradient steps, or None.
        step_size: length of a gradient step per unit of gradient, or None.
    """

    horizon: int = 5
    time_step: float = 0.1
    iterations: int | None = None
    step_size: float | None = None


PAPER_PLANNING = PlanningSettings()
"""The paper's: half a second ahead, in `PAPER_STEPS`."""


@cache
def gradient_steps(planning: PlanningSettings) -> tuple[int, float]:
    """Return number and size of the gradient steps of a plan, chosen where the settings leave them open.

    The step size is the paper's 0.03, or 0.6 of the `longest_step` where that is shorter; the number of steps keeps the
    product of the paper's 20 steps of 0.03, but is at least 20. At 0.1 s: 20 steps of 0.03 up to K = 7, 58 of 0.0104 at
    K = 10, and 929 of 0.00065 at K = 20.
    """
    papers_number, papers_length = PAPER_STEPS
    length = planning.step_size or min(papers_length, STEP_SHARE * longest_step(planning.horizon, planning.time_step))
    return planning.iterations or max(papers_number, round(papers_number * papers_length / length)), length


@cache
def longest_step(horizon: int, time_step: float) -> float:
    """Return the longest gradient step that does not overshoot the optimum of the paper's steepest feature.

    To first order, control j moves the car sideways by ``y_k = v dt^2 (k - 1 - j)`` at step k. With s the largest
    singular value of this matrix, the curvature of ``-w y^2``, summed over the steps, is at most ``2 w s^2``; its
    inverse is the step that reaches the optimum at once.
    """
    steps = np.arange(horizon)
    moved = SPEED * time_step**2 * np.maximum(np.subtract.outer(steps, steps), 0)
    steepest = 2 * STEEPEST * float(np.linalg.norm(moved, 2)) ** 2
    return 1 / steepest if steepest > 0 else np.inf


def longest_traced_step(horizon: int, time_step: Scalar) -> Scalar:
    """Return `longest_step` for a time step that JAX may trace: it falls with its fourth power."""
    return longest_step(horizon, time_step=1.0) / jnp.asarray(time_step) ** 4
