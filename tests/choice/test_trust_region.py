"""Trust region steps are optimal."""

import jax
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from ms_highway.choice.quadratic import trust_region_step

RADIUS = 1.5


def problems(dimensions):
    """Yield convex, concave and indefinite quadratics over many scales.

    Among them are hard cases and vanishing slopes.
    """
    random = np.random.default_rng(0)
    for number in range(60):
        entries = random.normal(size=(dimensions, dimensions))
        quadratic = entries * 10 ** random.uniform(-3, 2)
        quadratic = quadratic + quadratic.T if number % 3 else -quadratic @ quadratic.T
        linear = random.normal(size=dimensions) * 10 ** random.uniform(-4, 2)
        if number % 7 == 0:
            linear = np.linalg.eigh(quadratic)[1][:, 0] * linear[0]
        yield quadratic, linear * (number % 11 > 0)


def best_value(quadratic, linear):
    """Return the optimum in the ball: the least value of the dual.

    The dual is convex in the multiplier.
    """
    values, vectors = np.linalg.eigh(quadratic)
    along = (vectors.T @ linear) ** 2
    least = max(0.0, values[-1])

    def dual(logarithm):
        multiplier = least + np.exp(logarithm)
        return multiplier * RADIUS**2 / 2 + np.sum(along / (multiplier - values)) / 2

    return minimize_scalar(
        dual, bounds=(-30, 10), method="bounded", options={"xatol": 1e-6}
    ).fun


solve = jax.jit(trust_region_step)


@pytest.mark.parametrize(("dimensions", "tolerance"), [(2, 1e-4), (20, 1e-3)])
def test_the_trust_region_step_is_optimal(dimensions, tolerance):
    for quadratic, linear in problems(dimensions):
        step = np.asarray(
            solve(np.float32(quadratic), np.float32(linear), RADIUS, 0.0), dtype=float
        )
        best = best_value(quadratic, linear)
        assert np.linalg.norm(step) <= RADIUS * 1.0001
        assert (
            step @ quadratic @ step / 2 + linear @ step
            >= best - tolerance * abs(best) - 1e-9
        )


def test_a_tolerance_stops_the_trust_region_step_near_the_radius():
    quadratic = np.float32([[-0.1, 0.02], [0.02, -0.2]])
    linear = np.float32([0.4, 0.3])
    length = np.linalg.norm(solve(quadratic, linear, RADIUS, 0.05))
    assert 0.95 * RADIUS <= length <= 1.05 * RADIUS
