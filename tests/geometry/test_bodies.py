"""Distances of bodies are the same in NumPy and JAX."""

import numpy as np
import pytest
from highway_env.utils import are_polygons_intersecting, rect_corners
from jax import numpy as jnp

from ms_highway.geometry.bodies import separation


def polygon(x, y, heading, length, width):
    return rect_corners([x, y], length, width, heading)[[0, 1, 2, 3, 0]]


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray])
def test_rectangles_are_apart_exactly_where_highway_env_says_so(kind):
    random, number, own = np.random.default_rng(0), 300, (0.5, -0.3, 2.0)
    others = *random.uniform(-6, 6, (2, number)), random.uniform(-7, 7, number)
    sizes = random.uniform(0.5, 6, (number, 2))
    found = np.asarray(separation(tuple(map(kind, own)), kind([5.0, 2.0]), others, sizes))
    for place, size, apart in zip(np.transpose(others), sizes, found, strict=True):
        touching, *_ = are_polygons_intersecting(
            polygon(*own, 5.0, 2.0), polygon(*place, *size), np.zeros(2), np.zeros(2)
        )
        assert abs(apart) < 1e-3 or touching == (apart < 0)
    assert 0.2 < np.mean(found < 0) < 0.8
