"""The curvature of rewards along a motion, compared with derivatives by JAX."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.features import motion_reward
from ms_highway.game.payoff import Payoff
from ms_highway.game.reward import FEATURES, linear_reward
from ms_highway.game.scenario import PAPER_UNIT, build_game
from ms_highway.game.scenarios import DENSE_MERGE

ROAD = build_game(DENSE_MERGE, humans=2).scene
LED = replace(ROAD, leader=2)


@jax.jit
def bends(scene, reward, own, others):
    payoff = Payoff(scene, reward, None, True)
    return payoff.curvature(own, jnp.stack(others, axis=1))[..., 0]


@jax.jit
def hessian(scene, reward, own, others):
    def cost(fields):
        own = Motion(*fields[:, None])
        return -jnp.sum(motion_reward(scene, reward, own, others, smooth=True))

    return jax.hessian(cost)(own[:, 0])


def motion(y, heading, x=0.0):
    return np.stack(observe(np.array([[x, y, heading, 18.0]], np.float32)))


def near(random, x):
    states = random.normal((x, -1.5, 0, 20), (6, 2, 0.1, 3), size=(2, 1, 4))
    return observe(states.astype(np.float32))


FAR = near(np.random.default_rng(0), 500)


@pytest.mark.parametrize("name", ["speed", "target_lane", "gap"])
def test_the_curvature_of_a_square_is_its_second_derivative(name):
    at = LED, linear_reward({name: 70.0}, 20.0), motion(-1.0, 0.05), FAR
    bent = np.asarray(bends(*at))
    exact = np.array(hessian(*at))
    assert abs(exact).max() > 1e-3
    if name == "speed":  # the product of speed and cosine counts as linear
        exact[[2, 4], [4, 2]] = bent[[2, 4], [4, 2]]
    np.testing.assert_allclose(bent, exact, rtol=1e-3, atol=1e-6)


def test_the_curvature_of_closeness_bounds_its_hessian_closely():
    reward = linear_reward({"collision_risk": -1.0, "collision": -100.0}, 20.0)
    random = np.random.default_rng(0)
    larger = []
    for _ in range(20):
        y = random.uniform(-4, 1)
        heading = random.normal(0, 0.2)
        own = motion(y, heading, x=random.uniform(50, 66))
        at = LED, reward, own, near(random, 60)
        bent = np.asarray(bends(*at))
        exact = np.asarray(hessian(*at))
        rounding = 1e-4 * np.abs(bent).max() + 1e-4
        assert np.linalg.eigvalsh(bent - exact)[0] > -rounding
        assert np.linalg.eigvalsh(bent + exact)[0] > -rounding
        largest = np.abs(np.linalg.eigvalsh(exact)).max()
        larger.append(np.linalg.eigvalsh(bent)[-1] / largest)
    assert np.median(larger) < 2.5


@pytest.mark.parametrize("contact", ["paper", "bodies"])
def test_the_curvature_of_any_reward_is_positive_semidefinite(contact):
    random = np.random.default_rng(0)
    road = replace(ROAD, contact=contact)
    for _ in range(20):
        own = motion(random.uniform(-7, 4), random.normal(0, 0.2))
        weights = dict(zip(FEATURES, random.normal(0, 100, len(FEATURES)), strict=True))
        reward = linear_reward(weights, 20.0, gap=0.3 * PAPER_UNIT)
        bent = bends(road, reward, own, near(random, 0))
        assert np.linalg.eigvalsh(bent)[0] > -1e-4 * np.abs(bent).max()


@pytest.mark.parametrize("contact", ["paper", "bodies"])
def test_the_curvature_of_a_gap_without_a_leader_is_zero(contact):
    road = replace(ROAD, contact=contact)
    reward = linear_reward({"gap": 70.0}, 20.0, names=FEATURES)
    assert not bends(road, reward, motion(0.0, 0.0), FAR).any()
