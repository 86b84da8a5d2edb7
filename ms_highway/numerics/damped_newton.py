"""Solve with a Hessian that is damped until it can be factored.

A multiple of the identity makes the negative Hessian definite, without eigenvalues,
also where the reward is not concave (Levenberg 1944; Nocedal and Wright). The best
responses of `ms_highway.road` step with it; the joint ascent does not.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Float

from ms_highway.runtime.arrays import Matrix, Vector


@dataclass(frozen=True)
class DampedSteps:
    """Set the dampings and the shares of steps that are tried."""

    first: float = 1.0
    """First damping [reward per squared scaled control]."""
    growth: float = 6.0
    """Factor from one damping to the next."""
    last: float = 1e7
    """Damping beyond which none is tried [reward per squared scaled control]."""
    tried_shares: tuple[float, ...] = (1, 1 / 2, 1 / 4, 1 / 10, 1 / 32, 0)
    """Shares of a damped step that its line search tries."""

    @property
    def shares(self) -> Float[np.ndarray, "shares"]:
        """Shares of a damped step that its line search tries, in single precision."""
        return np.array(self.tried_shares, dtype=np.float32)


DAMPED_STEPS = DampedSteps()


class _Attempt(NamedTuple):
    """A damping, and the Cholesky factor with it, not finite if there is none."""

    damping: jax.Array
    factor: jax.Array


def damped_solve(hessian: Matrix, vector: Vector) -> jax.Array:
    """Return ``(d I - H)^-1 vector`` with the first damping that allows a factor.

    The dampings d are 1, 6, 36, ...; the factor is Cholesky's. Zero where the result is
    not finite.
    """
    symmetric = (hessian + hessian.T) / 2
    identity = jnp.eye(len(hessian))

    def attempt(damping: jax.Array) -> _Attempt:
        shifted = damping * identity - symmetric
        factor = jnp.linalg.cholesky(shifted, symmetrize_input=False)
        return _Attempt(damping, factor)

    def goes_on(last: _Attempt) -> jax.Array:
        fails = ~jnp.isfinite(last.factor).all()
        return fails & (last.damping < DAMPED_STEPS.last)

    def with_more(last: _Attempt) -> _Attempt:
        more = DAMPED_STEPS.growth * last.damping
        return attempt(more)

    # Damp more until the factor is finite.
    first = attempt(jnp.float32(DAMPED_STEPS.first))
    found = jax.lax.while_loop(goes_on, with_more, first)

    solved = cho_solve((found.factor, True), vector)
    is_finite = jnp.isfinite(solved).all()
    return jnp.where(is_finite, solved, 0.0)
