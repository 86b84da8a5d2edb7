"""Symmetric matrices whose eigenvalues are bounded from below."""

from collections.abc import Sequence

import jax
import numpy as np
import pytest

from ms_highway.optimization.floored import floored


def symmetric(seed: int, eigenvalues: Sequence[float]) -> np.ndarray:
    vectors = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(eigenvalues),) * 2))[0]
    return (vectors * eigenvalues) @ vectors.T


@pytest.mark.parametrize("eigenvalues", [(3.0, 3.0, 2.0, 1.5), (3.0, 3.0, -1.0, -1.0), (0.2, -0.3, -5.0, 4.0)])
def test_floored_eigenvalues_have_exact_derivatives_also_where_they_meet(eigenvalues):
    with jax.enable_x64(True):
        matrix, change = symmetric(0, eigenvalues), symmetric(1, (1.0, -0.5, 0.3, 0.7))
        np.testing.assert_allclose(
            np.linalg.eigvalsh(floored(matrix, 1.0)), np.sort(np.maximum(eigenvalues, 1.0)), atol=1e-12
        )
        slope = jax.jvp(floored, (matrix, 1.0), (change, 0.4))[1]
        difference = (floored(matrix + 1e-6 * change, 1 + 4e-7) - floored(matrix - 1e-6 * change, 1 - 4e-7)) / 2e-6
        np.testing.assert_allclose(slope, difference, atol=1e-7)
