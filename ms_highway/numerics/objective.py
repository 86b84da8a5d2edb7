"""State what is optimised over the controls of a plan."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.numerics.second_derivatives import Expansion, along_fields, second_order_expansion
from ms_highway.runtime.arrays import Controls, ManyControls, Numbers, Scalar, Trajectory


class Objective(NamedTuple):
    """Maximise ``reward(path(controls)) - cost(controls)`` over scaled controls within limits.

    Attributes:
        path: trajectory under controls.
        reward: of a trajectory, a sum over its steps.
        cost: of the controls themselves, a sum over them.
        bounded: projects controls on their limits.
        slope: derivative of the reward in a trajectory.
        curvature: a convex form of minus the reward's second derivatives at each step of a trajectory, for
            `ms_highway.numerics.convex_newton`.
        jacobian: derivative of the path in the ravelled controls, for the same.
    """

    path: Callable[[Controls], Trajectory]
    reward: Callable[[Trajectory], Scalar]
    cost: Callable[[Controls], Scalar]
    bounded: Callable[[ManyControls], ManyControls]
    slope: Callable[[Trajectory], Trajectory]
    curvature: Callable[[Trajectory], Float[Any, "fields fields steps"]] | None = None
    jacobian: Callable[[Controls], Float[Any, "fields steps controls"]] | None = None

    def earned(self, controls: Controls, path: Trajectory | None = None) -> Scalar:
        """Return what controls earn on their path; the path is computed unless it is given."""
        return self.reward(self.path(controls) if path is None else path) - self.cost(controls)

    def gradient(self, controls: Controls) -> Controls:
        """Return the derivative of `earned`."""
        path, pull_back = jax.vjp(self.path, controls)
        return pull_back(self.slope(path))[0] - jax.grad(self.cost)(controls)

    def gain(self, controls: Controls, step: Controls) -> Scalar:
        """Return the derivative of `earned` along a step that ends at these controls."""
        path, moved = jax.jvp(self.path, (controls,), (step,))
        return jnp.sum(self.slope(path) * moved) - jnp.sum(jax.grad(self.cost)(controls) * step)

    def expand(self, controls: Controls) -> Expansion:
        """Return the expansion of `earned` to second order."""
        return second_order_expansion(self.path, controls, *along_fields(self.slope, self.path(controls)), self.cost)

    def search_line(
        self, controls: Controls, step: Controls, shares: Float[Any, "shares"]
    ) -> tuple[ManyControls, Float[Any, "shares"]]:
        """Return the controls after shares of a step, within the limits, and what they earn."""
        candidates = self.bounded(controls + shares[:, None, None] * step)
        return candidates, jax.vmap(self.earned)(candidates)


def best_of(candidates: Numbers, earned: Float[Any, "candidates"]) -> Numbers:
    """Return the candidate that earns most among those with a finite reward; NaN where there is none."""
    known = jnp.isfinite(earned)
    best = candidates[jnp.argmax(jnp.where(known, earned, -jnp.inf))]
    return jnp.where(known.any(), best, jnp.nan)
