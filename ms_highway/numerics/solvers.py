"""Improve the controls of a plan by projected gradient ascent or Newton steps; choose the number and size of steps."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Literal, TypeAlias

import jax
import numpy as np

from ms_highway.numerics.convex_newton import JOINT_STEPS, STEPS, Point, convex_newton_steps
from ms_highway.numerics.newton import Objective, newton_steps
from ms_highway.runtime.arrays import Control, Controls, Index, Scalar

Solver: TypeAlias = Literal["gradient", "newton", "convex_newton"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Planner:
    """Horizon, solver and limits of plans.

    Attributes:
        control_scale: unit of each control; steps are taken in ``u / control_scale``, so that a larger scale means
            larger steps of that control. ``(1, 1)`` in the units of the reward is the plain gradient.
        control_limit: bound on the magnitude of each control, infinite for none.
        grip: total acceleration that tyres hold [m/s^2]; plans are cut down to it and do not reverse, see
            `ms_highway.game.game.bounded`. None for no such limit.
        step_size: length of a gradient step per unit of gradient.
        horizon: number of planned controls, K in the paper (static).
        iterations: number of gradient steps (static).
        newton_steps: number of steps of the solver for seconds at most (static).
        joint_steps: the same where humans respond to each of them (static).
        ease: cost of plans, beside their reward, per squared scaled control that does not keep the velocity, so that
            they do not follow every bump of the reward at once; less for steering at low speed, see
            `ms_highway.game.game.discomfort`.
        solver: ``gradient``, the paper's, ``newton`` or ``convex_newton``, see `optimize_controls` (static).
        smooth: whether plans climb a reward without jumps, keep room to stop before obstacles and, without a last plan,
            start from constant velocity instead of the paper's zero controls (static).
        persistent: whether plans start from the rest of the last plan or, under a smooth reward, from a simple
            manoeuvre that earns more (static).
    """

    control_scale: Control
    control_limit: Control
    grip: Scalar | None = None
    step_size: Scalar = 0.03
    ease: Scalar = 0.0
    horizon: int = field(default=5, metadata={"static": True})
    iterations: int = field(default=20, metadata={"static": True})
    newton_steps: int = field(default=STEPS, metadata={"static": True})
    joint_steps: int = field(default=JOINT_STEPS, metadata={"static": True})
    solver: Solver = field(default="gradient", metadata={"static": True})
    smooth: bool = field(default=False, metadata={"static": True})
    persistent: bool = field(default=False, metadata={"static": True})

    @property
    def steps(self) -> tuple[int, int]:
        """Largest numbers of steps of a plan: where no human responds to it, and where some human does."""
        if self.solver == "convex_newton":
            return self.newton_steps, self.joint_steps
        return self.iterations, self.iterations


def projected_ascent(
    planner: Planner,
    direction: Callable[[Point], Point],
    start: Point,
    bounded: Callable[[Point], Point],
    steps: Index,
) -> Point:
    """Improve controls by projected steps, ``z <- bounded(z + step_size * direction(z))``.

    Args:
        planner: with the step size.
        direction: of ascent at given controls; the gradient of the objective for gradient ascent.
        start: first controls, an array [..., 2] or a pytree of them, scaled.
        bounded: projects scaled controls on their limits.
        steps: their number.

    Returns:
        The improved controls, like ``start``, within the limits.
    """

    def improve(_: int, controls: Point) -> Point:
        slopes = direction(controls)
        return bounded(jax.tree.map(lambda u, slope: u + planner.step_size * slope, controls, slopes))

    return jax.lax.fori_loop(0, steps, improve, start)


def optimize_controls(planner: Planner, objective: Objective, start: Controls) -> Controls:
    """Maximise an objective locally, from scaled controls, by the planner's solver.

    * ``gradient``: `projected_ascent` along the reward's gradient g, the paper's solver.
    * ``newton``: 16 steps along ``sum_i v_i v_i^T g / max(|l_i|, 12)``, with the eigenpairs (l_i, v_i) of the Hessian,
      computed every 8 steps. Such a step ascends even where the reward is not concave (the saddle-free Newton step of
      Dauphin et al. 2014). The line search takes the best of the step, its halves and no step, projected on the limits.
      Unlike the gradient, it sees jumps of the reward, such as the cost of a collision.
    * ``convex_newton``: for horizons of seconds, a few steps of continuous length up a smooth reward. Plans then change
      steadily with what is seen, see `ms_highway.numerics.convex_newton`.
    """
    if planner.solver == "gradient":
        return projected_ascent(planner, objective.gradient, start, objective.bounded, planner.iterations)
    if planner.solver == "newton":
        return newton_steps(objective, start)
    return convex_newton_steps(objective, start, planner.newton_steps)


# Number and size of gradient steps; the constants are those of the paper's scenes

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
