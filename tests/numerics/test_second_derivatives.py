"""Second derivatives, responses and bounded eigenvalues."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.numerics.second_derivatives import floored, response


@pytest.mark.parametrize("size", [2, 5])
def test_the_exact_response_solves_the_linear_equations(size):
    random = np.random.default_rng(0)
    for _ in range(10):
        matrix, push = random.normal(size=(size, size)), random.normal(size=(size, 2))
        matrix = matrix + matrix.T + 3 * np.eye(size)
        answer = response("exact", jnp.float32(matrix), jnp.float32(push))
        np.testing.assert_allclose(matrix @ answer, -push, atol=1e-4 * abs(np.linalg.inv(matrix)).max())


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
