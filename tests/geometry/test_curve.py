"""Coordinates along winding lines, in NumPy and in JAX, also beyond the ends.

`tests/properties/test_curves.py` holds the same of all arcs.
"""

import gymnasium as gym
import highway_env  # noqa: F401
import jax
import numpy as np
import pytest

from ms_highway.geometry.curve import Curve
from ms_highway.geometry.road_map import road_map
from ms_highway.recorded.network import smooth_curves


def line_of_a_map():
    """A winding line that is not smooth."""
    along = np.arange(0.0, 200.0, 4.0)
    jagged = 0.05 * np.random.default_rng(0).normal(size=along.size)
    aside = 10 * np.sin(along / 40) + jagged
    return next(smooth_curves(np.stack([along, aside], axis=-1)))


def through_a_roundabout():
    env = gym.make("roundabout-v1").unwrapped
    env.reset(seed=0)
    roads = road_map(env.road.network)
    first = roads.lanes["ser", "ses", 0]
    lanes = roads.goal("nxs").ahead(first, 200.0)
    return roads.chain(lanes).curve(0).curve


CURVES = {
    "line of a map": line_of_a_map(),
    "roundabout": through_a_roundabout(),
}


def places(own, number=500):
    """Random s, d and relative headings near a curve, some of them beyond its ends."""
    random = np.random.default_rng(0)
    s = random.uniform(own.start - 30.0, own.end + 30.0, number)
    farthest = min(6.0, 0.5 / np.abs(own.curvature).max(initial=0.01))
    d = random.uniform(-farthest, farthest, number)
    return s, d, random.uniform(-3.0, 3.0, number)


def unambiguous(own, s, d):
    """Which places are beside their own part of the curve, and nearest to it."""
    x, y, _ = own.place(s, d)
    nearest = np.hypot(x[:, None] - own.x, y[:, None] - own.y).argmin(axis=1)
    s_of_nearest = own.start + own.spacing * nearest
    return np.abs(s_of_nearest - np.clip(s, own.start, own.end)) < 15.0


def placed_and_projected(own, s, d, turned):
    """Poses at places, and the coordinates of poses there that are turned."""
    x, y, heading = own.place(s, d)
    return (x, y, heading), own.project(x, y, heading + turned + 2 * np.pi)


by_jax = jax.jit(placed_and_projected)


@pytest.mark.parametrize("own", CURVES.values(), ids=CURVES)
def test_places_and_projections_are_inverse_in_numpy_and_jax(own):
    s, d, turned = places(own)
    clear = unambiguous(own, s, d)
    assert clear.mean() > 0.5
    poses, projected = placed_and_projected(own, s, d, turned)
    poses_by_jax, projected_by_jax = by_jax(own, s, d, turned)
    np.testing.assert_allclose(poses_by_jax, poses, atol=1e-3)
    for found in (projected, projected_by_jax):
        for values, true in zip(found, (s, d, turned), strict=True):
            np.testing.assert_allclose(
                np.asarray(values)[clear], true[clear], atol=0.01
            )


@pytest.mark.parametrize("own", CURVES.values(), ids=CURVES)
def test_a_curve_goes_straight_on_beyond_its_ends(own):
    for end, side in ((own.start, -1), (own.end, 1)):
        x, y, heading = own.place(np.array([end, end + side * 25.0]), np.zeros(2))
        assert heading[0] == heading[1]
        np.testing.assert_allclose(np.hypot(x[1] - x[0], y[1] - y[0]), 25.0, rtol=1e-5)
        np.testing.assert_allclose(own.bend(np.array([end + side])), 0.0)


def test_a_curve_through_a_circle_has_its_curvature():
    angle = np.arange(0.0, 2.0, 0.5 / 15)
    own = Curve.through(15 * np.sin(angle), 15 - 15 * np.cos(angle), spacing=0.5)
    np.testing.assert_allclose(own.curvature, 1 / 15, rtol=0.01)
    np.testing.assert_allclose(own.heading, angle[: len(own.x)], atol=1e-3)
