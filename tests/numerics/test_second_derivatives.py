"""Second derivatives, responses and bounded eigenvalues."""

import jax
import numpy as np
import pytest

from ms_highway.numerics.second_derivatives import floored, minus_inverse_times


def test_the_exact_response_is_exact_and_the_damped_one_ascends():
    random = np.random.default_rng(0)

    @jax.jit
    def responses(matrix, push):
        exact = minus_inverse_times("exact", matrix, push)
        damped = minus_inverse_times("damped", matrix, push)
        return exact, damped

    for _ in range(20):
        matrix = random.normal(0, 3, (5, 5))
        push = random.normal(size=5)
        matrix = matrix + matrix.T
        exact, damped = responses(np.float32(matrix), np.float32(push))
        atol = 1e-4 * abs(np.linalg.inv(matrix)).max()
        np.testing.assert_allclose(matrix @ exact, -push, atol=atol)
        assert np.dot(damped, push) > 0
        assert np.linalg.norm(damped) <= np.linalg.norm(push) * 1.001


def symmetric(seed, eigenvalues):
    size = len(eigenvalues)
    random = np.random.default_rng(seed).normal(size=(size, size))
    vectors, _ = np.linalg.qr(random)
    return (vectors * eigenvalues) @ vectors.T


@jax.jit
def floored_and_slope(matrix, floor, change):
    return jax.jvp(floored, (matrix, floor), (change, 0.4))


@pytest.mark.parametrize(
    "eigenvalues", [(3.0, 3.0, -1.0, -1.0), (0.2, -0.3, -5.0, 4.0)]
)
def test_floored_eigenvalues_have_exact_derivatives_also_where_they_meet(eigenvalues):
    matrix = symmetric(0, eigenvalues)
    change = symmetric(1, (1.0, -0.5, 0.3, 0.7))
    with jax.enable_x64(True):
        now, slope = floored_and_slope(matrix, 1.0, change)
        more, _ = floored_and_slope(matrix + 1e-6 * change, 1 + 4e-7, change)
        less, _ = floored_and_slope(matrix - 1e-6 * change, 1 - 4e-7, change)
        np.testing.assert_allclose(slope, (more - less) / 2e-6, atol=1e-7)
    expected = np.sort(np.maximum(eigenvalues, 1.0))
    np.testing.assert_allclose(np.linalg.eigvalsh(now), expected, atol=1e-12)
