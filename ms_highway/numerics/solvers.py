"""Improve the controls of a plan: projected gradient ascent, or Newton steps with a line search."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.numerics.convex_newton import JOINT_STEPS, STEPS, Point, convex_newton_steps
from ms_highway.numerics.newton import newton_steps
from ms_highway.numerics.objective import Objective
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


def project(planner: Planner, controls: Float[jax.Array, "*batch 2"]) -> Float[jax.Array, "*batch 2"]:
    """Clip scaled controls to ``control_limit``; for all limits see `ms_highway.game.game.bounded`."""
    limit = jnp.asarray(planner.control_limit) / jnp.asarray(planner.control_scale)
    return jnp.clip(controls, -limit, limit)


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
