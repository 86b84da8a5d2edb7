"""Distances of bodies are the same in NumPy and JAX."""

import jax
import numpy as np
import pytest
from highway_env.utils import are_polygons_intersecting, rect_corners

from ms_highway.geometry.bodies import separation


def polygon(place, size):
    *position, heading = place
    return rect_corners(position, *size, heading)[[0, 1, 2, 3, 0]]


@pytest.mark.parametrize("function", [separation, jax.jit(separation)])
def test_rectangles_are_apart_exactly_where_highway_env_says_so(function):
    random = np.random.default_rng(0)
    number = 300
    own = (0.5, -0.3, 2.0)
    still = np.zeros(2)
    others = (
        random.uniform(-6, 6, number),
        random.uniform(-6, 6, number),
        random.uniform(-7, 7, number),
    )
    sizes = random.uniform(0.5, 6, (number, 2))
    found = np.asarray(function(own, np.array([5.0, 2.0]), others, sizes))
    for place, size, apart in zip(np.transpose(others), sizes, found, strict=True):
        touching, *_ = are_polygons_intersecting(
            polygon(own, (5.0, 2.0)), polygon(place, size), still, still
        )
        assert abs(apart) < 1e-3 or touching == (apart < 0)
    assert 0.2 < np.mean(found < 0) < 0.8
