"""Climb by Newton steps whose result is a continuous function of the start.

They are for plans whose horizon is several seconds long. The curvature of the reward is
made convex (`ms_highway.game.payoff`) and the trajectory is taken as linear
(Gauss-Newton), so that every factorisation succeeds and a fixed damping suffices.

The share of a step that is taken is at the top of the parabola with the slopes at both
ends of the step: float32 resolves slopes where it loses the gain in rounding. No step
chooses among candidates, so that similar starts lead to similar plans. The start itself
may be chosen, by a margin: see `ms_highway.planning.plans.best_start`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import jax
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Float, PyTree

from ms_highway.numerics.objective import Objective
from ms_highway.numerics.second_derivatives import second_order_expansion
from ms_highway.runtime.arrays import (
    Controls,
    Flag,
    Index,
    Matrix,
    Scalar,
    Trajectory,
    Vector,
)

Iterate = TypeVar("Iterate", bound=PyTree)


@dataclass(frozen=True)
class NewtonSteps:
    """Set the number, the length and the end of Newton steps.

    `steps`, `joint_steps` and `damping` were chosen by how sensitive runs are in Dense
    Merge: the 95th percentile, over 100 starts, of the distance after two seconds
    between two runs that start 10 um apart.
    """

    steps: int = 8
    """Largest number of steps of plans to which nobody responds. The distance is 0.27
    mm with naive plans of eight steps.
    """
    joint_steps: int = 4
    """Largest number of steps of plans to which others respond. Such steps climb no
    single reward, and more of them are less steady: under theory of mind, the distance
    is 0.73 mm with four of them, 2.0 mm with six and 13 mm with eight.
    """
    ease: float = 5.0
    """Weight on the control effort of the robot, the ``ease`` of
    `ms_highway.numerics.solvers.Newton`, in scenarios with these steps [reward per
    squared scaled control]: braking by 4 m/s^2 costs 0.04 per step.

    Measured in 60 starts of Dense Merge under theory of mind, with a damping of 10:

    * 2: reward of 6.06 per step, 3 collisions;
    * 5: reward of 6.63 per step, no collision;
    * 10: reward of 6.33 per step, 1 collision.
    """
    damping: float = 2.0
    """Levenberg's damping, which bounds a step where the reward is flat [reward per
    squared scaled control]. Less makes runs more sensitive: with four joint steps and
    an earlier form of the stopping cost, the distance was 1.1 mm at 1.5, and 1.5 mm at
    1.
    """
    max_step: float = 1.0
    """Largest norm of a step [scaled controls]: full braking for two seconds."""
    tolerance: float = 1e-3
    """Norm of a step that is not worth taking [scaled controls]."""
    min_share: float = 0.05
    """Smallest share of a step that is taken."""
    fade_end: float = 0.1
    """A short step of which no more than this fraction is taken ends the iteration, see
    `until_still`.
    """


NEWTON_STEPS = NewtonSteps()


class LocalModel(NamedTuple):
    """A concave quadratic model of an objective around n ravelled controls.

    Attributes:
        gradient: in the controls.
        factor: lower Cholesky factor of its damped curvature C.
        jacobian: of the trajectory in the controls.
    """

    gradient: Vector
    factor: Matrix
    jacobian: Float[jax.Array, "fields steps n"]

    def solve(self, vector: Vector) -> Vector:
        """Return ``C^-1 vector``."""
        return cho_solve((self.factor, True), vector)

    def step(self, gradient: Vector) -> Vector:
        """Return ``C^-1 gradient``, shortened to the largest step."""
        whole = self.solve(gradient)
        longest = NEWTON_STEPS.max_step
        norm = jnp.sqrt(jnp.sum(whole**2))
        scale = jnp.minimum(1.0, longest / jnp.maximum(norm, longest))
        return whole * scale


def expand(
    objective: Objective,
    controls: Controls,
    path: Trajectory | None = None,
    slope: Trajectory | None = None,
) -> LocalModel:
    """Model an objective around controls.

    With ``J_k = ds_k / du`` of the motion at step k, the reward's convex curvature Q_k
    there and the costs' second derivative D, ``C = sum_k J_k^T Q_k J_k + D + damping
    I``.

    Args:
        objective: to climb.
        controls: where to expand.
        path: trajectory under the controls, where it is known.
        slope: of the reward in the trajectory, where it is known.
    """
    assert objective.curvature is not None
    assert objective.jacobian is not None
    if path is None:
        path = objective.path(controls)
    if slope is None:
        slope = objective.slope(path)

    # The gradient, and minus C without its damping: J is given, so that the trajectory
    # is taken as linear.
    negative_curvature = -objective.curvature(path)
    gradient, hessian, jacobian = second_order_expansion(
        objective.path,
        controls,
        slope,
        negative_curvature,
        objective.cost,
        objective.jacobian(controls),
    )

    # Damp and factor C.
    identity = jnp.eye(controls.size)
    curvature = NEWTON_STEPS.damping * identity - hessian
    factor = jnp.linalg.cholesky(curvature, symmetrize_input=False)
    return LocalModel(gradient, factor, jacobian)


def best_share(slope_at_start: Scalar, slope_at_end: Scalar) -> jax.Array:
    """Return the share of a step at the top of a parabola with its slopes at both ends.

    With the slopes g at the start and g' at the end, it is ``g / (g - g')``, at least
    `NewtonSteps.min_share` and at most 1. It is 1 where the reward still rises at the
    end, and the least share where it falls at both ends, or where g' is not finite. It
    is NaN where g is not finite, so that the plan fails and says so.

    Args:
        slope_at_start: derivative of the reward along the whole step, at its start.
        slope_at_end: the same at its end.
    """
    least = NEWTON_STEPS.min_share
    rise = jnp.maximum(slope_at_start, 0.0)
    fall = jnp.minimum(slope_at_end, -1e-9)  # no division by 0
    top = jnp.where(slope_at_end < 0, rise / (rise - fall), 1.0)
    limited = jnp.maximum(top, least)
    share = jnp.where(jnp.isfinite(slope_at_end), limited, least)
    return jnp.where(jnp.isfinite(slope_at_start), share, jnp.nan)


def improve(objective: Objective, controls: Controls, model: LocalModel) -> Controls:
    """Return controls after a step, within the limits.

    At least `NewtonSteps.min_share` of a step is taken. So the objective may decrease
    in one step, for example where even this share leads into a collision.

    Args:
        objective: to climb.
        controls: within the limits.
        model: of the objective around them.
    """
    whole = model.step(model.gradient).reshape(controls.shape)

    # The slopes at both ends of the step that the limits leave.
    full_step = objective.bounded(controls + whole)
    step = full_step - controls
    slope_at_end = objective.slope_along(full_step, step)
    slope_at_start = model.gradient @ step.ravel()
    share = best_share(slope_at_start, slope_at_end)

    # A share of the step before limits: controls at a limit stay there.
    return objective.bounded(controls + share * whole)


class _Progress(NamedTuple, Generic[Iterate]):
    """An iterate, the fraction taken of the last step, and the number of steps."""

    iterate: Iterate
    fade: jax.Array
    steps: jax.Array


def until_still(
    step: Callable[[Index, Iterate], Iterate],
    start: Iterate,
    most: Index,
    controls_of: Callable[[Iterate], PyTree],
) -> tuple[Iterate, Index, Flag]:
    """Repeat a step until it hardly moves anything.

    A step whose norm is between the tolerance and twice that is faded: a fraction of it
    is taken. Of a shorter one, nothing is taken. So a similar start that takes one step
    more or less ends in nearly the same iterate. All arrays of the iterate are faded
    alike, also trajectories: they fit its controls to first order.

    Args:
        step: takes the index of the step and an iterate, and returns the next one.
        start: first iterate.
        most: largest number of steps.
        controls_of: returns those of an iterate; their change is the norm of a step.

    Returns:
        The last iterate, the number of steps that were computed, and whether the last
        one hardly moved the controls.
    """

    def take_step(now: _Progress[Iterate]) -> _Progress[Iterate]:
        before = now.iterate
        after = step(now.steps, before)

        # The fraction to take, by the norm of the step.
        change = jax.tree.map(jnp.subtract, after, before)
        moved = jax.tree.leaves(controls_of(change))
        squared = sum(jnp.sum(array**2) for array in moved)
        norm = jnp.sqrt(squared)
        fade = jnp.clip(norm / NEWTON_STEPS.tolerance - 1, 0.0, 1.0)

        # Of a whole step, take the end itself, as old + 1 * difference would round.
        def faded(
            old: jax.Array,
            new: jax.Array,
            difference: jax.Array,
        ) -> jax.Array:
            return jnp.where(fade < 1, old + fade * difference, new)

        taken = jax.tree.map(faded, before, after, change)
        return _Progress(taken, fade, now.steps + 1)

    def goes_on(now: _Progress[Iterate]) -> jax.Array:
        return (now.fade > NEWTON_STEPS.fade_end) & (now.steps < most)

    first = _Progress(start, fade=jnp.ones(()), steps=jnp.zeros((), int))
    last = jax.lax.while_loop(goes_on, take_step, first)
    is_still = last.fade <= NEWTON_STEPS.fade_end
    return last.iterate, last.steps, is_still
