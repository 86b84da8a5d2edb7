"""Choose the number and size of gradient steps for a horizon and a time step."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ms_highway.runtime.arrays import Scalar

MAX_ITERATIONS = 5000
"""Upper bound on the gradient steps of a plan; more take seconds."""

PAPER_STEPS = 20, 0.03  # number and size
STEP_SHARE = 0.6
"""Share of the `longest_step` that plans take where the wanted step is longer."""

STEEPEST = 1000.0  # the largest weight on a squared lateral distance in the paper's scenes [1 / length unit^2]
SPEED = 0.6  # the paper's speed limit [length units per second]


@dataclass(frozen=True)
class PlanningSettings:
    """Horizon, time step and gradient steps of the plans of robot and human alike.

    They depend on each other: the reward's curvature in the controls grows with the fourth power of the horizon, and a
    gradient step longer than `longest_step` overshoots. With K = 10, the paper's step size of 0.03 makes theory of mind
    earn -9 in Merger; 60 steps of 0.01 earn 6.4. `gradient_steps` chooses the values that are None.

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
    """Return the number and the size of a plan's gradient steps, chosen where the settings leave them open.

    The step size is the paper's 0.03 or, if that is shorter, 0.6 of the `longest_step`. The number of steps times
    their size is that of the paper, 20 times 0.03, but there are at least 20 steps. With time steps of 0.1 s, these are
    20 steps of 0.03 up to K = 7, 58 of 0.0104 at K = 10, and 929 of 0.00065 at K = 20.
    """
    number, size = PAPER_STEPS
    length = planning.step_size or min(size, STEP_SHARE * longest_step(planning.horizon, planning.time_step))
    return planning.iterations or max(number, round(number * size / length)), length


def longest_step(horizon: int, time_step: Scalar) -> Scalar:
    """Return the longest gradient step that does not overshoot the optimum of the paper's steepest feature.

    To first order, control j moves the car sideways by ``y_k = v dt^2 (k - 1 - j)`` at step k. With s the largest
    singular value of this matrix, the curvature of ``-w y^2``, summed over the steps, is at most ``2 w s^2``. The
    inverse of the curvature is the step that reaches the optimum at once.

    Args:
        horizon: number of planned controls.
        time_step: dt [s]; JAX may trace it.
    """
    steps = np.arange(horizon)
    moved = SPEED * np.maximum(np.subtract.outer(steps, steps), 0)  # per dt^2
    steepest = 2 * STEEPEST * float(np.linalg.norm(moved, 2)) ** 2
    return (1 / steepest if steepest > 0 else np.inf) / time_step**4
