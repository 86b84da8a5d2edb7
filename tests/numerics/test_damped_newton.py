"""Newton steps that are damped until the Hessian can be factored."""

import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.numerics.damped_newton import damped_factor, damped_solve


@pytest.mark.parametrize("shift", [-3.0, 5.0, 300.0])
def test_the_factor_is_of_the_negative_hessian_with_the_least_damping_of_its_series(shift):
    random = np.random.default_rng(1).normal(size=(8, 8))
    hessian = jnp.asarray(random + random.T + shift * np.eye(8), jnp.float32)
    factor = np.asarray(damped_factor(hessian))
    damping = np.mean(np.diag(factor @ factor.T + hessian))
    rounds = np.log(damping) / np.log(6.0)
    np.testing.assert_allclose(rounds, np.round(rounds), atol=1e-3)
    np.testing.assert_allclose(factor @ factor.T + hessian, damping * np.eye(8), atol=1e-4 * damping)
    largest = np.linalg.eigvalsh(hessian)[-1]
    assert largest < damping <= 6.0 * max(largest, 1.0)
    vector = np.arange(8.0, dtype=np.float32)
    np.testing.assert_allclose((damping * np.eye(8) - hessian) @ damped_solve(factor, vector), vector, atol=1e-3)
