"""Define the `Objective` of the controls of a plan, and maximise it by Newton's method.

`damped_solve` is a Newton step that needs no eigenvalues.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Float

from ms_highway.numerics.second_derivatives import (
    Expansion,
    along_fields,
    second_order_expansion,
)
from ms_highway.runtime.arrays import (
    Controls,
    Flag,
    ManyControls,
    Matrix,
    Numbers,
    Scalar,
    Trajectory,
    Vector,
)


class Objective(NamedTuple):
    """Maximise ``reward(path(controls)) - cost(controls)`` over scaled controls within
    limits.

    Attributes:
        path: trajectory under controls.
        reward: of a trajectory, a sum over its steps.
        cost: of the controls themselves, a sum over them.
        bounded: projects controls on their limits.
        slope: derivative of the reward in a trajectory.
        curvature: a convex form of minus the reward's second derivatives at each step
            of a trajectory, for `ms_highway.numerics.convex_newton`.
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
        """Return what controls earn on their path; the path is computed unless it is
        given.
        """
        return self.reward(self.path(controls) if path is None else path) - self.cost(
            controls
        )

    def gain(self, controls: Controls, step: Controls) -> Scalar:
        """Return the derivative of `earned` along a step that ends at these controls."""
        path, moved = jax.jvp(self.path, (controls,), (step,))
        return jnp.sum(self.slope(path) * moved) - jnp.sum(
            jax.grad(self.cost)(controls) * step
        )

    def expand(self, controls: Controls) -> Expansion:
        """Return the expansion of `earned` to second order."""
        return second_order_expansion(
            self.path,
            controls,
            *along_fields(self.slope, self.path(controls)),
            self.cost,
        )

    def search_line(
        self, controls: Controls, step: Controls, shares: Float[Any, "shares"]
    ) -> tuple[ManyControls, Float[Any, "shares"]]:
        """Return the controls after shares of a step, limited by `bounded`, and the
        value of `earned` for each.
        """
        candidates = self.bounded(controls + shares[:, None, None] * step)
        return candidates, jax.vmap(self.earned)(candidates)


def best_of(candidates: Numbers, earned: Float[Any, "candidates"]) -> Numbers:
    """Return the candidate that earns most among those with a finite reward; NaN where
    there is none.
    """
    known = jnp.isfinite(earned)
    best = candidates[jnp.argmax(jnp.where(known, earned, -jnp.inf))]
    return jnp.where(known.any(), best, jnp.nan)


DAMPED_SHARES = np.array([1, 1 / 2, 1 / 4, 1 / 10, 1 / 32, 0], dtype=np.float32)
"""Shares of a damped step that its line search tries."""

MIN_DAMPING, DAMPING_GROWTH, MAX_DAMPING = (
    1.0,
    6.0,
    1e7,
)  # reward per squared scaled control


def damped_solve(hessian: Matrix, vector: Vector) -> Vector:
    """Return ``(d I - H)^-1 vector``, with the first damping d of 1, 6, 36, ... for
    which a Cholesky factor exists.

    Where the reward is not concave, the multiple of the identity makes its negative
    Hessian definite, without eigenvalues (Levenberg 1944; Nocedal and Wright). Zero
    where the result is not finite.
    """
    symmetric = (hessian + hessian.T) / 2
    identity = jnp.eye(len(hessian))

    def factored(damping: Scalar) -> tuple[Scalar, Matrix]:
        return damping, jnp.linalg.cholesky(
            damping * identity - symmetric, symmetrize_input=False
        )

    def fails(tried: tuple[Scalar, Matrix]) -> Flag:
        return ~jnp.isfinite(tried[1]).all() & (tried[0] < MAX_DAMPING)

    first = factored(jnp.float32(MIN_DAMPING))
    _, factor = jax.lax.while_loop(
        fails, lambda tried: factored(DAMPING_GROWTH * tried[0]), first
    )
    solved = cho_solve((factor, True), vector)
    return jnp.where(jnp.isfinite(solved).all(), solved, 0.0)
