"""State what is optimised over the controls of a plan."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.optimization.second_derivatives import Expansion, second_order_expansion
from ms_highway.runtime.arrays import Controls, ManyControls, Numbers, Scalar, Trajectory


def flat(trajectory: Trajectory) -> Float[Any, "steps fields fields"]:
    """Return no curvature."""
    fields, steps = trajectory.shape
    return jnp.zeros((steps, fields, fields))


class Objective(NamedTuple):
    """Maximise ``reward(path(controls)) - cost(controls)`` over scaled controls within limits.

    Attributes:
        path: trajectory under controls.
        reward: of a trajectory, a sum over its steps.
        cost: of the controls themselves, a sum over them.
        bounded: projects controls on their limits.
        curvature: a convex form of how the reward bends at each step of a trajectory, for
            `ms_highway.optimization.convex_newton`; by default, none.
        path_jacobian: derivative of the path in the ravelled controls, for steps of the same; by default, JAX finds it.
    """

    path: Callable[[Controls], Trajectory]
    reward: Callable[[Trajectory], Scalar]
    cost: Callable[[Controls], Scalar]
    bounded: Callable[[ManyControls], ManyControls]
    curvature: Callable[[Trajectory], Float[Any, "steps fields fields"]] = flat
    path_jacobian: Callable[[Controls], Float[Any, "fields steps controls"]] | None = None

    def earned(self, controls: Controls, path: Trajectory | None = None) -> Scalar:
        """Return what controls earn on their path, which is computed where it is not known."""
        return self.reward(self.path(controls) if path is None else path) - self.cost(controls)

    def jacobian(self, controls: Controls) -> Float[Any, "fields steps controls"]:
        """Return the derivative of the path in the ravelled controls."""
        if self.path_jacobian is not None:
            return self.path_jacobian(controls)
        return jax.jacfwd(lambda point: self.path(point.reshape(-1, 2)))(controls.ravel())

    def expand(self, controls: Controls) -> Expansion:
        """Return the expansion of `earned` to second order."""
        return second_order_expansion(self.path, self.reward, controls, self.cost)

    def search_line(
        self, controls: Controls, step: Controls, shares: Float[Any, "shares"]
    ) -> tuple[ManyControls, Float[Any, "shares"]]:
        """Return the controls after shares of a step, within the limits, and what they earn."""
        candidates = self.bounded(controls + shares[:, None, None] * step)
        return candidates, jax.vmap(self.earned)(candidates)


def best_of(candidates: Numbers, earned: Float[Any, "candidates"]) -> Numbers:
    """Return the candidate that earns most of those that earn something finite; NaN where none does."""
    known = jnp.isfinite(earned)
    best = candidates[jnp.argmax(jnp.where(known, earned, -jnp.inf))]
    return jnp.where(known.any(), best, jnp.nan)
