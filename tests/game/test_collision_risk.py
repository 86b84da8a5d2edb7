"""The risk of a collision has the value of its formula."""

import jax
import numpy as np

from ms_highway.game.collision_risk import RISK
from ms_highway.game.features import features
from ms_highway.game.reward import PAPER_FEATURES, linear_reward
from ms_highway.geometry.bodies import CORNERS, MIDDLES


def by_formula(scene, cars):
    """The risk of the first of some cars.

    Nine points of its body are seen in the frame of every other car and obstacle.
    Points are complex numbers, x + iy.
    """
    in_sizes = np.concatenate([scene.corner * CORNERS, MIDDLES])
    along, across = (in_sizes * scene.car_size).T
    x, y, heading, _ = cars[0]
    points = x + 1j * y + (along + 1j * across) * np.exp(1j * heading)

    def closeness(x, y, heading, size, sharpness):
        offset = (points - x - 1j * y) * np.exp(-1j * heading)
        along = 2 * offset.real / size[0]
        across = 2 * offset.imag / size[1]
        return np.sum(np.exp(-sharpness * (along**2 + across**2 - 1)))

    others = sum(
        closeness(*car[:3], scene.car_size, RISK.car_sharpness) for car in cars[1:]
    )
    cones = sum(
        closeness(*cone, 0.0, scene.obstacle_size, RISK.obstacle_sharpness)
        for cone in scene.obstacles
    )
    return others + RISK.obstacle_share * cones


def test_the_risk_of_a_collision_is_that_of_its_formula(played):
    """Four cars are near a cone, in any direction.

    Derivatives are JAX's, see the slopes of all features.
    """
    scene = played("stay_back")[0].scene
    place = PAPER_FEATURES.index("collision_risk")
    random = np.random.default_rng(0)
    states = random.normal(0, [3, 3, 1, 2], (6, 4, 4)).astype(np.float32)
    states[..., :2] += scene.obstacles[0]
    risks = jax.jit(
        lambda states: features(scene, linear_reward({}, 20.0), states)[..., place]
    )
    expected = [by_formula(scene, cars) for cars in states]
    assert max(expected) > 0.1, "the cars should be close"
    np.testing.assert_allclose(risks(states), expected, rtol=1e-4, atol=1e-4)
