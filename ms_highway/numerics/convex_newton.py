"""Climb by Newton steps whose result is a continuous function of the start, for plans
of seconds.

The curvature of the reward is made convex (`ms_highway.game.payoff`) and the trajectory
is taken as linear (Gauss-Newton), so that every factorisation succeeds and no damping
is searched for. The share of a step that is taken is at the top of the parabola with
the slopes at both ends of the step: float32 resolves slopes where it loses the gain in
rounding. Nothing is chosen among candidates, so that plans from similar starts are
similar.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Float, PyTree

from ms_highway.numerics.newton import Objective
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

STEPS = 8
JOINT_STEPS = 4
"""Largest numbers of steps of a plan by default, see `until_still`: alone, and where
others respond to each step.

Steps to which others respond climb no single reward, and more of them are less steady.
Measured in Dense Merge under theory of mind, for 95 % of 100 starts that are 10 um
apart: two seconds later, they are within 0.73 mm of each other with four such steps,
2.0 mm with six and 13 mm with eight. With naive plans of eight steps, they are within
0.27 mm.
"""

EASE = 5.0
"""Usual ease of `ms_highway.numerics.solvers.Newton`: braking by 4 m/s^2 costs 0.04 per
step.

Measured in 60 starts of Dense Merge under theory of mind, with an earlier damping of
10: 6.06 per step and 3 collisions at 2, 6.63 and none at 5, 6.33 and 1 at 10.
"""

DAMPING = 2.0
"""Reward per squared scaled control: a step is short where nothing else bends the
reward.

Measured like the number of steps to which others respond, with four of them and an
earlier cost of room to stop: starts are within 1.1 mm of each other two seconds later
with a damping of 1.5, and within 1.5 mm with 1.
"""

MAX_STEP = 1.0  # norm of a step [scaled controls]: full braking for two seconds
STEP_TOLERANCE = 1e-3  # norm of a step that is not worth taking [scaled controls]
MIN_PART = 0.1  # of a step: if no more is taken, it is the last one
MIN_SHARE = 0.05  # of a step at least


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
        """Return ``C^-1 gradient``, shortened to `MAX_STEP`."""
        whole = self.solve(gradient)
        return whole * jnp.minimum(
            1.0, MAX_STEP / jnp.maximum(jnp.sqrt(jnp.sum(whole**2)), MAX_STEP)
        )


def expand(
    objective: Objective,
    controls: Controls,
    path: Trajectory | None = None,
    slope: Trajectory | None = None,
) -> Local:
    """Expand an objective around controls.

    With ``J_k = ds_k / du`` of the motion at step k, the reward's convex curvature Q_k
    there and the costs' second derivative D, ``C = sum_k J_k^T Q_k J_k + D + DAMPING
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
    curvature = DAMPING * jnp.eye(controls.size) - hessian
    return Local(
        gradient, jnp.linalg.cholesky(curvature, symmetrize_input=False), jacobian
    )


def share(slope: Scalar, after: Scalar) -> Scalar:
    """Return the share of a step at the top of the parabola that has the step's slopes
    at both ends.

    With the slopes g at the start and g' at the end, it is ``g / (g - g')``, at least
    `MIN_SHARE` and at most 1; it is 1 where the reward still rises at the end. NaN
    where g is not finite, so that the plan fails and says so.

    Args:
        slope: derivative of the reward along the whole step, at its start.
        after: the same at its end.
    """
    climbs = jnp.maximum(slope, 0.0)
    top = jnp.where(after < 0, climbs / (climbs - jnp.minimum(after, -1e-9)), 1.0)
    top = jnp.where(jnp.isfinite(after), jnp.maximum(top, MIN_SHARE), MIN_SHARE)
    return jnp.where(jnp.isfinite(slope), top, jnp.nan)


def improve(objective: Objective, controls: Controls, local: Local) -> Controls:
    """Return controls after a step, projected on the limits.

    At least `MIN_SHARE` of a step is taken; where that leads beyond a wall of the
    reward, controls may earn less for a step.

    Args:
        objective: to climb.
        controls: within the limits.
        local: the objective around them.
    """
    whole = local.step(local.gradient).reshape(controls.shape)
    tried = objective.bounded(controls + whole)
    step = tried - controls
    after = objective.gain(tried, step)
    return objective.bounded(
        controls + share(local.gradient @ step.ravel(), after) * whole
    )


def until_still(
    step: Callable[[Index, Point], Point],
    start: Point,
    most: Index,
    controls: Callable[[Point], Any],
) -> tuple[Point, Index, Flag]:
    """Repeat a step until it hardly moves anything.

    A step whose norm is between `STEP_TOLERANCE` and twice that is taken in part, a
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
        change = jax.tree.map(jnp.subtract, after, before)
        norm = jnp.sqrt(
            sum(jnp.sum(part**2) for part in jax.tree.leaves(controls(change)))
        )
        part = jnp.clip(norm / STEP_TOLERANCE - 1, 0.0, 1.0)

        def partial_step(old: Any, new: Any, moved: Any) -> Any:
            return jnp.where(part < 1, old + part * moved, new)

        point = jax.tree.map(partial_step, before, after, change)
        return point, part, number + 1

    def goes_on(now: tuple[Point, jax.Array, jax.Array]) -> Flag:
        _, part, number = now
        return (part > MIN_PART) & (number < most)

    first = (start, jnp.ones(()), jnp.zeros((), int))
    point, part, number = jax.lax.while_loop(goes_on, go, first)
    return point, number, part <= MIN_PART
