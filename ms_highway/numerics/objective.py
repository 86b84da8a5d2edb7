"""Define the `Objective` of the controls of a plan."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.numerics.second_derivatives import (
    Expansion,
    along_fields,
    second_order_expansion,
)
from ms_highway.runtime.arrays import (
    Array,
    Controls,
    ManyControls,
    Numbers,
    Scalar,
    Trajectory,
)

StepHessians: TypeAlias = Float[jax.Array, "fields fields steps"]
PathJacobian: TypeAlias = Float[jax.Array, "fields steps controls"]


class Objective(NamedTuple):
    """Maximise ``reward(path(controls)) - cost(controls)`` within limits.

    Controls are scaled.

    Attributes:
        path: trajectory under controls.
        reward: of a trajectory, a sum over its steps.
        cost: of the controls themselves, a sum over them.
        bounded: limits controls.
        slope: derivative of the reward in a trajectory.
        curvature: a positive semidefinite stand-in for minus the reward's Hessian at
            each step of a trajectory, for `ms_highway.numerics.convex_newton`.
        jacobian: derivative of the path in the ravelled controls, for the same.
    """

    path: Callable[[Controls], Trajectory]
    reward: Callable[[Trajectory], Scalar]
    cost: Callable[[Controls], Scalar]
    bounded: Callable[[ManyControls], ManyControls]
    slope: Callable[[Trajectory], Trajectory]
    curvature: Callable[[Trajectory], StepHessians] | None = None
    jacobian: Callable[[Controls], PathJacobian] | None = None

    def earned(self, controls: Controls, path: Trajectory | None = None) -> Scalar:
        """Return what controls earn on their path, computed unless it is given."""
        if path is None:
            path = self.path(controls)
        return self.reward(path) - self.cost(controls)

    def slope_along(self, controls: Controls, step: Controls) -> Scalar:
        """Return the derivative of `earned` along a step that ends at controls."""
        path, path_change = jax.jvp(self.path, (controls,), (step,))
        along_path = jnp.sum(self.slope(path) * path_change)
        cost_slope = jax.grad(self.cost)(controls)
        along_costs = jnp.sum(cost_slope * step)
        return along_path - along_costs

    def expand(self, controls: Controls) -> Expansion:
        """Return the expansion of `earned` to second order."""
        path = self.path(controls)
        slope, hessians = along_fields(self.slope, path)
        return second_order_expansion(self.path, controls, slope, hessians, self.cost)

    def search_line(
        self,
        controls: Controls,
        step: Controls,
        shares: Float[Array, "shares"],
    ) -> tuple[ManyControls, Float[Array, "shares"]]:
        """Return controls after shares of a step, limited, and what they earn."""
        taken = shares[:, None, None] * step  # [shares, steps, 2]
        candidates = self.bounded(controls + taken)
        earned = jax.vmap(self.earned)(candidates)
        return candidates, jnp.asarray(earned)


def best_of(candidates: Numbers, earned: Float[Array, "candidates"]) -> jax.Array:
    """Return the candidate that earns most among those with a finite reward.

    Return NaN where there is none.
    """
    known = jnp.isfinite(earned)
    comparable = jnp.where(known, earned, -jnp.inf)
    best = candidates[jnp.argmax(comparable)]
    return jnp.where(known.any(), best, jnp.nan)
