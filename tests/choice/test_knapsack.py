"""One rung for every human, most value within a capacity: as an exhaustive search finds it."""

from itertools import product

import jax
import numpy as np
import pytest

from ms_highway.choice.budget import best_rungs

solve = jax.jit(best_rungs)


def instance(random, humans, rungs):
    """Values and costs in eighths, so that sums are exact and often equal; some rungs are impossible."""
    values = random.integers(-8, 9, (humans, rungs)) / 8
    values[:, 1:][random.random((humans, rungs - 1)) < 0.1] = -np.inf
    costs = random.integers(0, 9, rungs) / 8
    costs[random.random(rungs) < 0.1] = random.choice([np.inf, np.nan])
    costs[0] = 0.0
    return values.astype(np.float32), costs.astype(np.float32), np.float32(random.integers(-1, 4 * humans) / 8)


def total(values, costs, rungs):
    return values[np.arange(len(values)), rungs].sum(), costs[rungs].sum()


@pytest.mark.parametrize(("humans", "rungs"), [(1, 2), (4, 3), (3, 4)])
def test_the_choice_is_the_best_of_all_and_the_cheapest_of_the_best(humans, rungs):
    random = np.random.default_rng(humans)
    assignments = [np.array(each) for each in product(range(rungs), repeat=humans)]
    for _ in range(200):
        values, costs, capacity = instance(random, humans, rungs)
        fitting = [total(values, costs, each) for each in assignments if costs[each].sum() <= capacity]
        found = np.asarray(solve(values, costs, capacity))
        if not fitting or max(fitting)[0] == -np.inf:
            assert (found == 0).all()
        else:
            most = max(value for value, _ in fitting)
            assert total(values, costs, found) == (most, min(cost for value, cost in fitting if value == most))
