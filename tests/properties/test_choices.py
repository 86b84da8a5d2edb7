"""Properties of choices: trust regions, budgets and beliefs over models."""

from itertools import product

import jax
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as draw
from scipy.optimize import minimize_scalar

from ms_highway.choice.belief import updated_probabilities
from ms_highway.choice.budget import best_rungs
from ms_highway.choice.quadratic import trust_region_step

RADIUS = 1.5

trust_region_step_in_jax = jax.jit(trust_region_step)
best_rungs_in_jax = jax.jit(best_rungs)


def arrays(shape, elements):
    """Return a strategy for arrays of a shape."""
    size = int(np.prod(shape))
    numbers = draw.lists(elements, min_size=size, max_size=size)
    return numbers.map(lambda drawn: np.array(drawn, dtype=float).reshape(shape))


# Trust region

eighths = draw.integers(-32, 32).map(lambda number: number / 8)
scales = draw.sampled_from([1e-4, 1e-2, 1.0, 1e2])


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

    found = minimize_scalar(
        dual, bounds=(-30, 10), method="bounded", options={"xatol": 1e-6}
    )
    return found.fun


def check_optimal(quadratic, linear, tolerance=1e-3):
    step = trust_region_step_in_jax(
        np.float32(quadratic), np.float32(linear), RADIUS, 0.0
    )
    step = np.asarray(step, dtype=float)
    value = step @ quadratic @ step / 2 + linear @ step
    best = best_value(quadratic, linear)
    assert np.linalg.norm(step) <= RADIUS * 1.0001
    assert value >= best - tolerance * abs(best) - 1e-9


@given(arrays((2, 2), eighths), arrays(2, eighths), scales, scales)
def test_the_trust_region_step_is_optimal(matrix, direction, bent, sloped):
    """Also for indefinite quadratics, vanishing slopes and hard cases."""
    check_optimal(bent * (matrix + matrix.T), sloped * direction, tolerance=1e-4)


slopes = draw.sampled_from(["any", "along an eigenvector", "none"])


@given(draw.integers(0, 1000), scales, scales, draw.booleans(), slopes)
def test_the_trust_region_step_is_optimal_in_many_dimensions(
    seed, bent, sloped, concave, slope
):
    """A slope along the eigenvector of the lowest eigenvalue is the hard case."""
    random = np.random.default_rng(seed)
    matrix = random.normal(size=(20, 20))
    quadratic = -matrix @ matrix.T if concave else matrix + matrix.T
    linear = random.normal(size=20)
    if slope == "along an eigenvector":
        _, vectors = np.linalg.eigh(quadratic)
        linear = vectors[:, 0] * linear[0]
    if slope == "none":
        linear = np.zeros(20)
    check_optimal(bent * quadratic, sloped * linear)


@given(arrays(2, eighths), draw.floats(0.01, 0.2))
def test_a_tolerance_stops_the_trust_region_step_near_the_radius(direction, tolerance):
    """The slope is steep enough that the best step leads to the radius."""
    quadratic = np.float32([[-0.1, 0.02], [0.02, -0.2]])
    length = np.linalg.norm(direction)
    assume(length > 0)
    linear = np.float32(direction / length)
    step = trust_region_step_in_jax(quadratic, linear, RADIUS, tolerance)
    assert np.linalg.norm(step) / RADIUS == pytest.approx(1.0, abs=1.01 * tolerance)


# Budgets


# In eighths, so that sums are exact and often equal.
worths = draw.one_of(
    draw.integers(-8, 8).map(lambda number: number / 8), draw.just(-np.inf)
)
prices = draw.one_of(
    draw.integers(0, 8).map(lambda number: number / 8),
    draw.sampled_from([np.inf, np.nan]),
)
capacities = draw.integers(-1, 16).map(lambda number: number / 8)


@pytest.mark.parametrize(("number", "rungs"), [(3, 4), (4, 3)])
@given(drawn=draw.data())
def test_a_budget_is_spent_as_an_exhaustive_search_spends_it(number, rungs, drawn):
    """The choice has the highest value, and the lowest cost for it."""
    first = drawn.draw(arrays((number, 1), eighths))
    higher = drawn.draw(arrays((number, rungs - 1), worths))
    values = np.concatenate([first, higher], axis=1)
    costs = np.concatenate([[0.0], drawn.draw(arrays(rungs - 1, prices))])
    capacity = drawn.draw(capacities)
    humans = np.arange(number)
    outcomes = {
        each: (values[humans, each].sum(), -costs[[*each]].sum())
        for each in product(range(rungs), repeat=number)
    }
    affordable = [pair for pair in outcomes.values() if -pair[1] <= capacity]
    best, cost = max(affordable, default=(-np.inf, 0.0))

    chosen = best_rungs_in_jax(
        np.float32(values), np.float32(costs), np.float32(capacity)
    )
    chosen = tuple(np.asarray(chosen).tolist())
    if best == -np.inf:
        assert not any(chosen)
    else:
        assert outcomes[chosen] == (best, cost)


# Beliefs over models

HUMANS = 3
MODELS = 4

beliefs = arrays((HUMANS, MODELS), draw.floats(0.01, 1.0)).map(
    lambda drawn: drawn / drawn.sum(axis=1, keepdims=True)
)
predicted = arrays((HUMANS, MODELS, 2), draw.floats(-10.0, 10.0))
observed = arrays((HUMANS, 2), draw.one_of(draw.floats(-40.0, 40.0), draw.just(np.nan)))


@given(beliefs, predicted, observed, draw.floats(0.01, 2.0))
def test_a_belief_stays_a_distribution_that_excludes_no_model(
    belief, predicted, observed, time_step
):
    after = updated_probabilities(belief, predicted, observed, time_step)
    assert (after > 0).all()
    np.testing.assert_allclose(after.sum(axis=1), 1.0)


@given(beliefs, predicted, observed, draw.permutations(range(HUMANS)))
def test_a_belief_does_not_depend_on_the_order_of_humans(
    belief, predicted, observed, order
):
    after = updated_probabilities(belief, predicted, observed, 0.1)
    reordered = updated_probabilities(
        belief[order], predicted[order], observed[order], 0.1
    )
    np.testing.assert_array_equal(reordered, after[order])


@given(predicted, draw.integers(0, MODELS - 1), draw.floats(0.01, 2.0))
def test_the_model_that_predicted_a_human_is_believed(predicted, model, time_step):
    before = np.full((HUMANS, MODELS), 1 / MODELS)
    after = updated_probabilities(before, predicted, predicted[:, model], time_step)
    assert (after[:, model] >= after.max(axis=1) - 1e-12).all()
