"""Trust region steps are optimal."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from scipy.optimize import brentq

from ms_highway.optimization.trust_region import trust_region_step

RADIUS = 1.5


def dense_ball():
    angles, radii = np.linspace(0, 2 * np.pi, 721), np.linspace(0, RADIUS, 151)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return (radii[:, None, None] * circle).reshape(-1, 2)


def problems():
    """Convex, concave and indefinite quadratics over many scales, with hard cases and vanishing slopes among them."""
    random = np.random.default_rng(0)
    for number in range(120):
        quadratic = random.normal(size=(2, 2)) * 10 ** random.uniform(-3, 2)
        quadratic = quadratic + quadratic.T
        if number % 3 == 0:
            quadratic = -quadratic @ quadratic
        linear = random.normal(size=2) * 10 ** random.uniform(-4, 2)
        if number % 7 == 0:
            linear = np.linalg.eigh(quadratic)[1][:, 0] * linear[0]
        if number % 11 == 0:
            linear = np.zeros(2)
        yield quadratic, linear


def test_the_trust_region_step_is_optimal_against_a_dense_grid():
    solve, ball = jax.jit(trust_region_step), dense_ball()
    for quadratic, linear in problems():

        def value(x, quadratic=quadratic, linear=linear):
            return np.einsum("...i,ij,...j", x, quadratic, x) / 2 + x @ linear

        step = np.asarray(solve(jnp.float32(quadratic), jnp.float32(linear), RADIUS), dtype=float)
        best = value(ball).max()
        assert np.linalg.norm(step) <= RADIUS * 1.0001
        assert value(step) >= best - 1e-4 * abs(best) - 1e-9


def secular_optimum(quadratic, linear):
    """The best value in the ball, from the multiplier that SciPy's root finder finds in double precision."""
    values, vectors = np.linalg.eigh(quadratic)
    along, least = vectors.T @ linear, max(0.0, values[-1])

    def step(multiplier):
        return along / (multiplier - values)

    if values[-1] < 0 and np.linalg.norm(step(0.0)) <= RADIUS:
        multiplier = 0.0
    else:
        low, high = least * (1 + 1e-12) + 1e-12, least + np.linalg.norm(linear) / RADIUS + 1e-6
        multiplier = brentq(lambda shift: np.linalg.norm(step(shift)) - RADIUS, low, high, xtol=1e-14)
    found = vectors @ step(multiplier)
    return found @ quadratic @ found / 2 + linear @ found


@pytest.mark.parametrize("dimensions", [3, 10, 20])
def test_the_trust_region_step_is_optimal_in_more_dimensions(dimensions):
    solve, random = jax.jit(trust_region_step), np.random.default_rng(0)
    for number in range(60):
        quadratic = random.normal(size=(dimensions, dimensions)) * 10 ** random.uniform(-3, 2)
        quadratic = quadratic + quadratic.T if number % 3 else -quadratic @ quadratic.T
        linear = random.normal(size=dimensions) * 10 ** random.uniform(-4, 2)
        step = np.asarray(solve(jnp.float32(quadratic), jnp.float32(linear), RADIUS), dtype=float)
        best = secular_optimum(quadratic, linear)
        assert np.linalg.norm(step) <= RADIUS * 1.0001
        assert step @ quadratic @ step / 2 + linear @ step >= best - 1e-3 * abs(best)


def test_a_flat_start_on_a_saddle_in_more_dimensions_ends_on_the_boundary_along_the_top_eigenvector():
    quadratic = jnp.diag(jnp.array([-3.0, -1.0, 0.5, 2.0]))
    step = np.asarray(trust_region_step(quadratic, jnp.array([1.0, 1.0, 0.0, 0.0]), RADIUS))
    np.testing.assert_allclose(step[:3], [0.2, 1 / 3, 0.0], atol=1e-5)
    assert np.linalg.norm(step) == pytest.approx(RADIUS, rel=1e-5)


def test_a_tolerance_stops_the_trust_region_step_near_the_radius():
    quadratic, linear = jnp.array([[-0.1, 0.02], [0.02, -0.2]]), jnp.array([0.4, 0.3])
    loose = trust_region_step(quadratic, linear, RADIUS, tolerance=0.05)
    assert 0.95 * RADIUS <= np.linalg.norm(loose) <= 1.05 * RADIUS
    assert np.linalg.norm(trust_region_step(quadratic, linear, RADIUS)) == pytest.approx(RADIUS, rel=1e-4)
