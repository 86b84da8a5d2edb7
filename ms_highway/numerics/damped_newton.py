"""Climb by Newton steps that are damped until a Cholesky factorisation succeeds (Levenberg 1944; Nocedal and Wright).

Where the reward is not concave, its negative Hessian plus a multiple of the identity is factored: no eigenvalues.
"""

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve

from ms_highway.runtime.arrays import Flag, Matrix, Scalar, Vector

SHARES = np.array([1, 1 / 2, 1 / 4, 1 / 10, 1 / 32, 0], dtype=np.float32)
"""Shares of a step that a line search tries."""

MIN_DAMPING, DAMPING_GROWTH, MAX_DAMPING = 1.0, 6.0, 1e7  # reward per squared scaled control


def damped_factor(hessian: Matrix) -> Matrix:
    """Return the lower Cholesky factor of ``d I - H``, with the first d of 1, 6, 36, ... for which there is one."""
    symmetric, identity = (hessian + hessian.T) / 2, jnp.eye(len(hessian))

    def factored(damping: Scalar) -> Matrix:
        return jnp.linalg.cholesky(damping * identity - symmetric, symmetrize_input=False)

    def fails(tried: tuple[Scalar, Matrix]) -> Flag:
        return ~jnp.isfinite(tried[1]).all() & (tried[0] < MAX_DAMPING)

    def grow(
        tried: tuple[Scalar, Matrix],
    ) -> tuple[Scalar, Matrix]:
        damping = DAMPING_GROWTH * tried[0]
        return damping, factored(damping)

    least = jnp.float32(MIN_DAMPING)
    return jax.lax.while_loop(fails, grow, (least, factored(least)))[1]


def damped_solve(factor: Matrix, vector: Vector) -> Vector:
    """Return ``(d I - H)^-1 vector`` by the factor of `damped_factor`; zero where that is not finite."""
    solved = cho_solve((factor, True), vector)
    return jnp.where(jnp.isfinite(solved).all(), solved, 0.0)
