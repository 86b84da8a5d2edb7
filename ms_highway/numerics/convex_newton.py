"""Climb by Newton steps that are a continuous function of where they start, for plans of seconds.

The curvature of the reward is made convex (`ms_highway.game.curvature`) and the trajectory counts as linear
(Gauss-Newton), so that every factorisation succeeds and no damping is searched for. The share of a step is that at the
top of the parabola with the slopes at both of its ends, which float32 resolves where the gain is lost in rounding.
Nothing is chosen among candidates: plans from starts that differ little differ little.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Float, PyTree

from ms_highway.numerics.objective import Objective
from ms_highway.numerics.second_derivatives import second_order_expansion
from ms_highway.runtime.arrays import Controls, Flag, Index, Matrix, Scalar, Trajectory, Vector

Point = TypeVar("Point", bound=PyTree)

STEPS, JOINT_STEPS = 8, 4
"""Default limits on the number of steps of a plan, see `until_still`: alone, and where others respond to each step.

Steps to which others respond climb no single reward, and more of them are less steady. Measured in Dense Merge under
theory of mind: starts 10 um apart are within 0.73 mm of each other two seconds later with four such steps, within
2.0 mm with six and within 13 mm with eight (95 % of 100). Naive plans of eight steps: within 0.27 mm."""

EASE = 5.0
"""Usual ease of a planner, see `ms_highway.numerics.solvers.Planner`: braking by 4 m/s^2 costs 0.04 per step.

Measured in 60 starts of Dense Merge under theory of mind, with an earlier damping of 10: 6.06 per step and 3 collisions
at 2, 6.63 and none at 5, 6.33 and 1 at 10."""

DAMPING = 2.0
"""Reward per squared scaled control: a step is short where nothing else bends the reward.

Measured in Dense Merge under theory of mind, with four steps and an earlier cost of room to stop: starts 10 um apart
are within 1.1 mm of each other two seconds later with a damping of 1.5, within 1.5 mm with 1 (95 % of 100)."""

MAX_STEP = 1.0  # norm of a step [scaled controls]: full braking for two seconds
STEP_TOLERANCE = 1e-3  # norm of a step that is not worth taking [scaled controls]
MIN_PART = 0.1  # of a step that is taken, up to which it is the last one
MIN_SHARE = 0.05  # of a step


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
        return whole * jnp.minimum(1.0, MAX_STEP / jnp.maximum(jnp.sqrt(jnp.sum(whole**2)), MAX_STEP))


def expand(objective: Objective, controls: Controls, slope: Trajectory | None = None) -> Local:
    """Expand an objective around controls.

    With ``J_k = ds_k / du`` of the motion at step k, the reward's convex curvature Q_k there and the costs' second
    derivative D, ``C = sum_k J_k^T Q_k J_k + D + DAMPING I``.

    Args:
        objective: to climb.
        controls: where to expand.
        slope: of the reward in the trajectory, where it is known.
    """
    assert objective.curvature is not None
    path = objective.path(controls)
    slope, bends = objective.along(path) if slope is None else slope, -objective.curvature(path)
    gradient, hessian, jacobian = second_order_expansion(
        objective.path, controls, slope, bends, objective.cost, objective.jacobian(controls)
    )
    curvature = DAMPING * jnp.eye(controls.size) - hessian
    return Local(gradient, jnp.linalg.cholesky(curvature, symmetrize_input=False), jacobian)


def share(slope: Scalar, after: Scalar) -> Scalar:
    """Return the share of a step at the top of the parabola that has its slopes at both of its ends.

    With the slope g where the step begins and g' after the whole of it, ``g / (g - g')``, at least `MIN_SHARE` and at
    most 1; 1 where it still climbs at its end. NaN where the first slope is not finite, so that the plan fails and says
    so.

    Args:
        slope: of what is earned along the whole step, where it begins.
        after: the same where it ends.
    """
    climbs = jnp.maximum(slope, 0.0)
    top = jnp.where(after < 0, climbs / (climbs - jnp.minimum(after, -1e-9)), 1.0)
    top = jnp.where(jnp.isfinite(after), jnp.maximum(top, MIN_SHARE), MIN_SHARE)
    return jnp.where(jnp.isfinite(slope), top, jnp.nan)


def improve(objective: Objective, controls: Controls, local: Local) -> Controls:
    """Return controls after a step, projected on the limits.

    A step is never shorter than `MIN_SHARE`: where that goes beyond a wall, controls may earn less for a step.

    Args:
        objective: to climb.
        controls: within the limits.
        local: the objective around them.
    """
    whole = local.step(local.gradient).reshape(controls.shape)
    tried = objective.bounded(controls + whole)
    step = tried - controls
    after = objective.gain(tried, step)
    return objective.bounded(controls + share(local.gradient @ step.ravel(), after) * whole)


def convex_newton_steps(objective: Objective, start: Controls, steps: Index = STEPS) -> Controls:
    """Improve controls by some steps at most, see `improve` and `until_still`."""
    return until_still(
        lambda controls: improve(objective, controls, expand(objective, controls)),
        objective.bounded(start),
        steps,
        lambda controls: controls,
    )


def until_still(step: Callable[[Point], Point], start: Point, most: Index, moving: Callable[[Point], Any]) -> Point:
    """Repeat a step until it hardly moves anything.

    A step whose norm is between `STEP_TOLERANCE` and twice that is taken in part, a shorter one not at all: where
    another start needs one step more or less, it ends in nearly the same point.

    Args:
        step: returns the next point.
        start: first point.
        most: number of steps at most.
        moving: returns the controls of a point, by whose change steps are measured.
    """

    def go(now: tuple[Point, Scalar, Index]) -> tuple[Point, Scalar, Index]:
        point, _, count = now
        after = step(point)
        gone = jax.tree.map(jnp.subtract, after, point)
        norm = jnp.sqrt(sum(jnp.sum(part**2) for part in jax.tree.leaves(moving(gone))))
        part = jnp.clip(norm / STEP_TOLERANCE - 1, 0.0, 1.0)
        return (
            jax.tree.map(lambda a, b, way: jnp.where(part < 1, a + part * way, b), point, after, gone),
            part,
            count + 1,
        )

    def goes_on(now: tuple[Point, Scalar, Index]) -> Flag:
        _, part, count = now
        return (part > MIN_PART) & (count < most)

    return jax.lax.while_loop(goes_on, go, (start, jnp.ones(()), jnp.zeros((), int)))[0]
