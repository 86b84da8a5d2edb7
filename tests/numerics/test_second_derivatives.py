"""Second derivatives, responses and bounded eigenvalues."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.numerics.second_derivatives import floored, response


def test_the_exact_response_solves_linear_equations_and_the_damped_one_always_ascends():
    random = np.random.default_rng(0)
    for _ in range(20):
        matrix, push = random.normal(0, 3, (5, 5)), random.normal(size=5)
        matrix = matrix + matrix.T
        exact, damped = (response(kind, jnp.float32(matrix), jnp.float32(push)) for kind in ("exact", "damped"))
        np.testing.assert_allclose(matrix @ exact, -push, atol=1e-4 * abs(np.linalg.inv(matrix)).max())
        assert damped @ push > 0
        assert np.linalg.norm(damped) <= np.linalg.norm(push) * 1.001


def symmetric(seed, eigenvalues):
    vectors = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(eigenvalues),) * 2))[0]
    return (vectors * eigenvalues) @ vectors.T


@pytest.mark.parametrize("eigenvalues", [(3.0, 3.0, 2.0, 1.5), (3.0, 3.0, -1.0, -1.0), (0.2, -0.3, -5.0, 4.0)])
def test_floored_eigenvalues_have_exact_derivatives_also_where_they_meet(eigenvalues):
    with jax.enable_x64(True):
        matrix, change = symmetric(0, eigenvalues), symmetric(1, (1.0, -0.5, 0.3, 0.7))
        expected = np.sort(np.maximum(eigenvalues, 1.0))
        np.testing.assert_allclose(np.linalg.eigvalsh(floored(matrix, 1.0)), expected, atol=1e-12)
        slope = jax.jvp(floored, (matrix, 1.0), (change, 0.4))[1]
        difference = (floored(matrix + 1e-6 * change, 1 + 4e-7) - floored(matrix - 1e-6 * change, 1 - 4e-7)) / 2e-6
        np.testing.assert_allclose(slope, difference, atol=1e-7)
