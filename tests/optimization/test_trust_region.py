"""Trust region steps are optimal."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

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


def test_a_tolerance_stops_the_trust_region_step_near_the_radius():
    quadratic, linear = jnp.array([[-0.1, 0.02], [0.02, -0.2]]), jnp.array([0.4, 0.3])
    loose = trust_region_step(quadratic, linear, RADIUS, tolerance=0.05)
    assert 0.95 * RADIUS <= np.linalg.norm(loose) <= 1.05 * RADIUS
    assert np.linalg.norm(trust_region_step(quadratic, linear, RADIUS)) == pytest.approx(RADIUS, rel=1e-4)
