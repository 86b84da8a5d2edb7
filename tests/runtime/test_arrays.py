"""Loops over chosen places."""

import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.runtime.arrays import for_each


@pytest.mark.parametrize("chosen", [[False] * 3, [True, False, True], [True] * 3])
def test_only_chosen_places_are_visited_each_once(chosen):
    visits = for_each(jnp.array(chosen), lambda place, found: found.at[place].add(1), jnp.zeros(3, int))
    np.testing.assert_array_equal(visits, chosen)
