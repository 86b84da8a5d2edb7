"""Take Newton steps that are damped until the Hessian can be factored.

Where the reward is not concave, a multiple of the identity makes its negative Hessian
definite, without eigenvalues (Levenberg 1944; Nocedal and Wright).
"""

from dataclasses import dataclass

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


def damped_solve(hessian: Matrix, vector: Vector) -> jax.Array:
    """Return ``(d I - H)^-1 vector`` with the first damping that allows a factor.

    The dampings d are 1, 6, 36, ...; the factor is Cholesky's. Zero where the result is
    not finite.
    """
    symmetric = (hessian + hessian.T) / 2
    identity = jnp.eye(len(hessian))

    def factored(damping: jax.Array) -> tuple[jax.Array, jax.Array]:
        shifted = damping * identity - symmetric
        return damping, jnp.linalg.cholesky(shifted, symmetrize_input=False)

    def fails(tried: tuple[jax.Array, jax.Array]) -> jax.Array:
        damping, factor = tried
        return ~jnp.isfinite(factor).all() & (damping < DAMPED_STEPS.last)

    def with_more(tried: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        damping, _ = tried
        return factored(DAMPED_STEPS.growth * damping)

    first = factored(jnp.float32(DAMPED_STEPS.first))
    _, factor = jax.lax.while_loop(fails, with_more, first)
    solved = cho_solve((factor, True), vector)
    return jnp.where(jnp.isfinite(solved).all(), solved, 0.0)
