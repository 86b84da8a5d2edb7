"""Climb by Newton steps whose result is a continuous function of the start.

They are for plans of seconds. The curvature of the reward is made convex
(`ms_highway.game.payoff`) and the trajectory is taken as linear (Gauss-Newton), so that
every factorisation succeeds and no damping is searched for. The share of a step that is
taken is at the top of the parabola with the slopes at both ends of the step: float32
resolves slopes where it loses the gain in rounding. Nothing is chosen among candidates,
so that plans from similar starts are similar.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

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

Point = TypeVar("Point", bound=PyTree)


@dataclass(frozen=True)
class NewtonSteps:
    """Set the number, the length and the end of Newton steps.

    Three values were measured in Dense Merge under theory of mind, by how far starts
    that are 10 um apart are from each other two seconds later, for 95 % of 100 starts.
    """

    steps: int = 8
    """Number of steps at most, where nobody responds to them. With naive plans of eight
    steps, starts are within 0.27 mm.
    """
    joint_steps: int = 4
    """Number of steps at most, where others respond to each of them. Such steps climb
    no single reward, and more of them are less steady: starts are within 0.73 mm with
    four of them, 2.0 mm with six and 13 mm with eight.
    """
    ease: float = 5.0
    """Usual ease of `ms_highway.numerics.solvers.Newton` [reward per squared scaled
    control]: braking by 4 m/s^2 costs 0.04 per step. In 60 starts of Dense Merge under
    theory of mind, with an earlier damping of 10: 6.06 per step and 3 collisions at 2,
    6.63 and none at 5, 6.33 and 1 at 10.
    """
    damping: float = 2.0
    """Reward per squared scaled control: a step is short where nothing else bends the
    reward. With four joint steps and an earlier cost of room to stop, starts are within
    1.1 mm at 1.5, and within 1.5 mm at 1.
    """
    max_step: float = 1.0
    """Largest norm of a step [scaled controls]: full braking for two seconds."""
    tolerance: float = 1e-3
    """Norm of a step that is not worth taking [scaled controls]."""
    min_share: float = 0.05
    """Share of a step that is taken at least."""
    last_part: float = 0.1
    """Part of a short step up to which it is the last one, see `until_still`."""


NEWTON_STEPS = NewtonSteps()


class Local(NamedTuple):
    """An objective around n ravelled controls.

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
        return whole * jnp.minimum(1.0, longest / jnp.maximum(norm, longest))


def expand(
    objective: Objective,
    controls: Controls,
    path: Trajectory | None = None,
    slope: Trajectory | None = None,
) -> Local:
    """Expand an objective around controls.

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
    bends = -objective.curvature(path)
    gradient, hessian, jacobian = second_order_expansion(
        objective.path,
        controls,
        slope,
        bends,
        objective.cost,
        objective.jacobian(controls),
    )
    curvature = NEWTON_STEPS.damping * jnp.eye(controls.size) - hessian
    factor = jnp.linalg.cholesky(curvature, symmetrize_input=False)
    return Local(gradient, factor, jacobian)


def share(slope: Scalar, after: Scalar) -> jax.Array:
    """Return the share of a step at the top of a parabola with its slopes at both ends.

    With the slopes g at the start and g' at the end, it is ``g / (g - g')``, at least
    `NewtonSteps.min_share` and at most 1; it is 1 where the reward still rises at the
    end. NaN where g is not finite, so that the plan fails and says so.

    Args:
        slope: derivative of the reward along the whole step, at its start.
        after: the same at its end.
    """
    least = NEWTON_STEPS.min_share
    climbs = jnp.maximum(slope, 0.0)
    falls = jnp.minimum(after, -1e-9)  # no division by 0
    top = jnp.where(after < 0, climbs / (climbs - falls), 1.0)
    top = jnp.where(jnp.isfinite(after), jnp.maximum(top, least), least)
    return jnp.where(jnp.isfinite(slope), top, jnp.nan)


def improve(objective: Objective, controls: Controls, local: Local) -> Controls:
    """Return controls after a step, projected on the limits.

    At least `NewtonSteps.min_share` of a step is taken; where that leads beyond a wall
    of the reward, controls may earn less for a step.

    Args:
        objective: to climb.
        controls: within the limits.
        local: the objective around them.
    """
    whole = local.step(local.gradient).reshape(controls.shape)

    # The slopes at both ends of the step that the limits leave.
    full_step = objective.bounded(controls + whole)
    step = full_step - controls
    after = objective.gain(full_step, step)
    part = share(local.gradient @ step.ravel(), after)
    return objective.bounded(controls + part * whole)


def until_still(
    step: Callable[[Index, Point], Point],
    start: Point,
    most: Index,
    controls: Callable[[Point], PyTree],
) -> tuple[Point, Index, Flag]:
    """Repeat a step until it hardly moves anything.

    A step whose norm is between the tolerance and twice that is taken in part, a
    shorter one not at all. So a similar start that takes one step more or less ends in
    nearly the same point.

    Args:
        step: takes the number of the step and a point, and returns the next point.
        start: first point.
        most: number of steps at most.
        controls: of a point; their change is the norm of a step.

    Returns:
        The last point, the number of steps, and whether the last one hardly moved the
        controls.
    """

    def go(
        now: tuple[Point, jax.Array, jax.Array],
    ) -> tuple[Point, jax.Array, jax.Array]:
        before, _, number = now
        after = step(number, before)

        # The part to take, by the norm of the step.
        change = jax.tree.map(jnp.subtract, after, before)
        moved = jax.tree.leaves(controls(change))
        norm = jnp.sqrt(sum(jnp.sum(part**2) for part in moved))
        part = jnp.clip(norm / NEWTON_STEPS.tolerance - 1, 0.0, 1.0)

        # A whole step ends exactly after it.
        def partial_step(
            old: jax.Array,
            new: jax.Array,
            difference: jax.Array,
        ) -> jax.Array:
            return jnp.where(part < 1, old + part * difference, new)

        point = jax.tree.map(partial_step, before, after, change)
        return point, part, number + 1

    def goes_on(now: tuple[Point, jax.Array, jax.Array]) -> jax.Array:
        _, part, number = now
        return (part > NEWTON_STEPS.last_part) & (number < most)

    first = (start, jnp.ones(()), jnp.zeros((), int))
    point, part, number = jax.lax.while_loop(goes_on, go, first)
    return point, number, part <= NEWTON_STEPS.last_part
