"""Second derivatives, responses and eigenpairs."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.optimization.second_derivatives import eigenpairs, jacobian_and_hessian, response


def symmetric_matrices():
    """Of all scales, with equal eigenvalues, diagonal ones, singular ones and zero among them."""
    random = np.random.default_rng(0)
    for number in range(60):
        matrix = random.normal(size=(2, 2)) * 10 ** random.uniform(-3, 3)
        yield np.diag(np.diag(matrix)) if number % 4 == 0 else matrix + matrix.T
    yield from (
        np.zeros((2, 2)),
        np.eye(2),
        -3 * np.eye(2),
        np.ones((2, 2)),
        np.diag([2.0, -1.0]),
        np.diag([-1.0, 2.0]),
    )


def test_two_by_two_eigenpairs_agree_with_lapack():
    compiled = jax.jit(eigenpairs)
    for matrix in symmetric_matrices():
        values, vectors = (np.asarray(part, dtype=float) for part in compiled(jnp.float32(matrix)))
        scale = max(abs(matrix).max(), 1e-30)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-6 * scale, rtol=1e-6)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(2), atol=1e-6)
        np.testing.assert_allclose((vectors * values) @ vectors.T, matrix, atol=2e-6 * scale)


@pytest.mark.parametrize("size", [2, 5])
def test_the_exact_response_solves_the_linear_equations(size):
    random = np.random.default_rng(0)
    for _ in range(20):
        matrix, push = random.normal(size=(size, size)), random.normal(size=(size, 2))
        matrix = matrix + matrix.T + 3 * np.eye(size)
        answer = response("exact", jnp.float32(matrix), jnp.float32(push))
        np.testing.assert_allclose(matrix @ answer, -push, atol=1e-4 * abs(np.linalg.inv(matrix)).max())


def test_slope_and_bend_are_the_first_two_derivatives():
    def function(variables):
        return jnp.sum(jnp.sin(variables[0]) * variables[1] ** 3)

    point = jnp.array([[0.3, -1.0], [0.7, 2.0]])
    slope, bend = jax.jit(jacobian_and_hessian(function))(point)
    np.testing.assert_allclose(slope, jax.jit(jax.grad(function))(point), rtol=1e-6)
    np.testing.assert_allclose(bend, jax.jit(jax.hessian(function))(point), rtol=1e-6)
