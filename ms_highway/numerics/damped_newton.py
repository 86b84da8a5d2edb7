"""Climb by Newton steps that are damped until a Cholesky factorisation succeeds (Levenberg 1944; Nocedal and Wright).

Where the reward is not concave, a multiple of the identity is added to its negative Hessian. This needs no eigenvalues.
"""

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve

from ms_highway.runtime.arrays import Flag, Matrix, Scalar, Vector

SHARES = np.array([1, 1 / 2, 1 / 4, 1 / 10, 1 / 32, 0], dtype=np.float32)
"""Shares of a step that a line search tries."""

MIN_DAMPING, DAMPING_GROWTH, MAX_DAMPING = 1.0, 6.0, 1e7  # reward per squared scaled control


def damped_solve(hessian: Matrix, vector: Vector) -> Vector:
    """Return ``(d I - H)^-1 vector``, with the first damping d of 1, 6, 36, ... for which a Cholesky factor exists.

    Zero where that is not finite.
    """
    symmetric, identity = (hessian + hessian.T) / 2, jnp.eye(len(hessian))

    def factored(damping: Scalar) -> tuple[Scalar, Matrix]:
        return damping, jnp.linalg.cholesky(damping * identity - symmetric, symmetrize_input=False)

    def fails(tried: tuple[Scalar, Matrix]) -> Flag:
        return ~jnp.isfinite(tried[1]).all() & (tried[0] < MAX_DAMPING)

    first = factored(jnp.float32(MIN_DAMPING))
    _, factor = jax.lax.while_loop(fails, lambda tried: factored(DAMPING_GROWTH * tried[0]), first)
    solved = cho_solve((factor, True), vector)
    return jnp.where(jnp.isfinite(solved).all(), solved, 0.0)
