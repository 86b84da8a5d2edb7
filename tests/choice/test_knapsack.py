"""The rungs of the highest total value within a capacity are those that an exhaustive
search finds.
"""

from itertools import product

import jax
import numpy as np
import pytest

from ms_highway.choice.budget import best_rungs

solve = jax.jit(best_rungs)


def instance(random, humans, rungs):
    """Draw values and costs in eighths, so that sums are exact and often equal; some
    rungs are impossible.
    """
    values = random.integers(-8, 9, (humans, rungs)) / 8
    values[:, 1:][random.random((humans, rungs - 1)) < 0.1] = -np.inf
    costs = random.integers(0, 9, rungs) / 8
    costs[random.random(rungs) < 0.1] = random.choice([np.inf, np.nan])
    costs[0] = 0.0
    return (
        values.astype(np.float32),
        costs.astype(np.float32),
        np.float32(random.integers(-1, 4 * humans) / 8),
    )


@pytest.mark.parametrize(("humans", "rungs"), [(4, 3), (3, 4)])
def test_the_choice_is_the_cheapest_of_the_highest_value(humans, rungs):
    random = np.random.default_rng(humans)
    assignments = list(product(range(rungs), repeat=humans))
    for _ in range(200):
        values, costs, capacity = instance(random, humans, rungs)
        worth = {
            each: (values[np.arange(humans), each].sum(), -costs[[*each]].sum())
            for each in assignments
        }
        best = max(
            (pair for pair in worth.values() if -pair[1] <= capacity),
            default=(-np.inf, 0),
        )
        found = tuple(np.asarray(solve(values, costs, capacity)).tolist())
        assert worth[found] == best if best[0] > -np.inf else not any(found)
