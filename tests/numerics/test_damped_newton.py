"""Newton steps that are damped until the Hessian can be factored."""

import jax
import numpy as np
import pytest

from ms_highway.numerics.damped_newton import damped_solve

solve = jax.jit(damped_solve)


@pytest.mark.parametrize("shift", [-3.0, 5.0, 300.0])
def test_a_step_has_the_least_damping_of_its_series(shift):
    random = np.random.default_rng(1).normal(size=(8, 8))
    hessian = np.float32(random + random.T + shift * np.eye(8))
    vector = np.arange(1.0, 9.0, dtype=np.float32)
    solved = np.asarray(solve(hessian, vector))
    curved = hessian @ solved

    # The damping d follows from (d I - H) solved = vector.
    damping = (vector + curved) @ solved / (solved @ solved)
    np.testing.assert_allclose(damping * solved - curved, vector, atol=1e-3)

    # It is 6^n for a whole n, and no larger than needed.
    rounds = np.log(damping) / np.log(6.0)
    np.testing.assert_allclose(rounds, np.round(rounds), atol=1e-3)
    largest = np.linalg.eigvalsh(hessian)[-1]
    assert largest < damping <= 6.0 * max(largest, 1.0)
