"""The curvature of rewards along a motion, compared with derivatives by JAX."""

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game import payoff as bending
from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import linear_reward
from ms_highway.game.scenario import PAPER_UNIT, build_game
from ms_highway.game.scenarios import DENSE_MERGE, MERGER

GAME = build_game(DENSE_MERGE, humans=2)
curvature = jax.jit(bending.curvature)
FAR = observe(np.array([[[500.0, 0.0, 0.0, 20.0]], [[600.0, 0.0, 0.0, 20.0]]], np.float32))


def motion(y, heading, x=0.0, speed=18.0):
    return observe(np.array([[x, y, heading, speed]], np.float32))


def bends(scene, reward, own, others):
    return np.asarray(curvature(scene, reward, jnp.stack(own), others)[..., 0])


def assert_semidefinite(difference, size):
    """Assert that a symmetric matrix has no eigenvalue below 0, up to rounding in numbers of this size."""
    assert np.linalg.eigvalsh(difference)[0] > -1e-4 * np.abs(size).max() - 1e-4


@jax.jit
def hessian(scene, reward, own, others):
    def cost(fields):
        return -jnp.sum(motion_reward(scene, reward, Motion(*fields[:, None]), others, smooth=True))

    return jax.hessian(cost)(jnp.concatenate([jnp.asarray(field) for field in own]))


@pytest.mark.parametrize("weights", [{"speed": 2.0}, {"target_lane": 150.0}, {"gap": 70.0}])
def test_where_a_feature_is_a_square_its_curvature_is_the_second_derivative(weights):
    scene = build_game(MERGER).scene if "gap" in weights else GAME.scene
    reward, own = linear_reward(weights, 20.0), motion(-1.0, 0.05)
    bent, exact = bends(scene, reward, own, FAR), hessian(scene, reward, own, FAR)
    kept = exact if "speed" not in weights else exact.at[2, 4].set(bent[2, 4]).at[4, 2].set(bent[4, 2])
    np.testing.assert_allclose(bent, kept, rtol=1e-3, atol=1e-6)  # the product of speed and cosine counts as linear


def test_a_gap_without_a_leader_has_no_curvature():
    assert not bends(GAME.scene, linear_reward({"gap": 70.0}, 20.0), motion(0.0, 0.0), FAR).any()


def test_the_curvature_of_closeness_bounds_its_hessian_and_is_not_much_larger():
    reward, random = linear_reward({"collision_risk": -1.0, "collision": -100.0}, 20.0), np.random.default_rng(0)
    larger = []
    for _ in range(20):
        own = motion(random.uniform(-4, 1), random.normal(0, 0.2), x=random.uniform(50, 66))
        near = observe(random.normal((60, -1.5, 0, 20), (6, 2, 0.1, 3), size=(2, 1, 4)).astype(np.float32))
        bent, exact = bends(GAME.scene, reward, own, near), np.asarray(hessian(GAME.scene, reward, own, near))
        assert_semidefinite(bent - exact, bent)
        assert_semidefinite(bent + exact, bent)
        larger.append(np.linalg.eigvalsh(bent)[-1] / np.abs(np.linalg.eigvalsh(exact)).max())
    assert np.median(larger) < 2.5


def test_the_curvature_of_any_reward_is_positive_semidefinite():
    random = np.random.default_rng(0)
    for _ in range(20):
        own = motion(random.uniform(-7, 4), random.normal(0, 0.2))
        near = random.normal((0, -1.5, 0, 20), (6, 2, 0.1, 3), size=(2, 1, 4)).astype(np.float32)
        names = ("speed", "lane_alignment", "collision_risk", "off_road", "gap", "headway", "closing_speed")
        reward = linear_reward({name: random.normal(0, 100) for name in names}, 20.0, gap=0.3 * PAPER_UNIT)
        bent = bends(GAME.scene, reward, own, observe(near))
        assert np.linalg.eigvalsh(bent)[0] > -1e-4 * np.abs(bent).max()
