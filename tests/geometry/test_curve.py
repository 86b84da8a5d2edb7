"""Coordinates of curves of all kinds are inverse to each other, in NumPy and in JAX, also beyond the ends."""

from functools import cache

import gymnasium as gym
import highway_env  # noqa: F401, registers the environments
import jax
import numpy as np
import pytest

from ms_highway.geometry.curve import Curve
from ms_highway.geometry.road_map import road_map
from ms_highway.recorded.network import fits
from tests.roads import arc, winding

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
BENDS = {"straight": 0.0, "gentle bend": -1 / 60, "bend": 1 / 30, "tight bend": 1 / 12}
CURVES = [*BENDS, "winding", "line of a map", "roundabout"]


@cache
def curve(name):
    if name in BENDS:
        return arc(24, BENDS[name])
    if name == "winding":
        return winding(0.03 * np.sin(np.maximum(np.arange(80) - 10, 0) / 4))
    if name == "line of a map":
        along = np.arange(0.0, 200.0, 4.0)
        jagged = 0.05 * np.random.default_rng(0).normal(size=along.size)
        return next(fits(np.stack([along, 10 * np.sin(along / 40) + jagged], axis=-1)))
    env = gym.make("roundabout-v0").unwrapped
    env.reset(seed=0)
    goal = road_map(env.road.network).goal("nxs")
    return goal.roads.chain(goal.ahead(goal.roads.lanes["ser", "ses", 0], 200.0)).curve(0).curve


def samples_of(own):
    """S of a curve's samples [m]."""
    return own.start + own.spacing * np.arange(len(own.x))


def places(own, number=500):
    """Random s, d and relative headings near a curve, some of them beyond its ends."""
    random = np.random.default_rng(0)
    s = random.uniform(own.start - 30.0, own.end + 30.0, number)
    farthest = min(6.0, 0.5 / np.abs(own.curvature).max(initial=0.01))
    return s, random.uniform(-farthest, farthest, number), random.uniform(-3.0, 3.0, number)


def apart(own, s, d):
    """Which places are unambiguous: no other part of the curve is nearer."""
    x, y, _ = own.place(s, d)
    beside = np.hypot(x[:, None] - own.x, y[:, None] - own.y)
    beside[np.abs(s[:, None] - samples_of(own)) < 15.0] = np.inf
    return beside.min(axis=1) > np.abs(d) + np.maximum(np.maximum(own.start - s, s - own.end), 0.0) + 1.0


@pytest.mark.parametrize("name", CURVES)
def test_places_and_projections_are_inverse_in_numpy_and_in_jax(name):
    own = curve(name)
    s, d, turned = places(own)
    clear = apart(own, s, d)
    assert clear.mean() > 0.5
    x, y, along = own.place(s, d)
    by_jax = jax.jit(Curve.place)(own, s, d), jax.jit(Curve.project)(own, x, y, along + turned + 2 * np.pi)
    np.testing.assert_allclose(by_jax[0], (x, y, along), atol=1e-3)
    for found in (own.project(x, y, along + turned + 2 * np.pi), by_jax[1]):
        for values, true in zip(found, (s, d, turned), strict=True):
            np.testing.assert_allclose(values[clear], true[clear], atol=0.01)


@pytest.mark.parametrize("name", CURVES)
def test_beyond_its_ends_a_curve_goes_straight_on(name):
    own = curve(name)
    for end, side in ((own.start, -1), (own.end, 1)):
        x, y, heading = own.place(np.array([end, end + side * 25.0]), np.zeros(2))
        assert heading[0] == heading[1]
        np.testing.assert_allclose(np.hypot(x[1] - x[0], y[1] - y[0]), 25.0, rtol=1e-5)
        np.testing.assert_allclose(own.bend(np.array([end + side])), 0.0)


def test_a_curve_through_points_of_a_circle_has_the_circles_curvature():
    angle = np.arange(0.0, 2.0, 0.5 / 15)
    own = Curve.through(15 * np.sin(angle), 15 - 15 * np.cos(angle), spacing=0.5)
    np.testing.assert_allclose(own.curvature, 1 / 15, rtol=0.01)
    np.testing.assert_allclose(own.heading, samples_of(own) / 15, atol=1e-3)
