"""Plans in closed form, against the reward whose best held control they are."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.dynamics import keep_velocity, observe
from ms_highway.game.game import rollout_reward
from ms_highway.game.learned_drivers import RewardTraits
from ms_highway.game.learned_reward import shipped
from ms_highway.game.neighbours import Leader
from ms_highway.game.reward import features_for
from ms_highway.game.scenario import driving_game
from ms_highway.game.scene import Scene
from ms_highway.planning.held_control import held_acceleration, held_curvature

WEIGHTS = shipped("us101").drivers.weights
LIMIT = 29.0


def best_of_reward(car, leader, traits, held):
    """Which of held controls earns most by the reward's own features, along or across."""
    scene = Scene(np.zeros(1), 3.4, np.empty((0, 2)), np.ones(2), np.array([5.0, 2.0]), 0.5, 0.0, 100 / 3)
    weights = {name: 1e3 * weight for name, weight in WEIGHTS.items()}
    game = driving_game(scene, traits.desired_speed, weights, features_for(weights), grip=None)
    comfort = np.asarray(game.robot.comfort) * [1.0, traits.patience]
    game = replace(game, robot=replace(game.robot, headway=traits.headway, comfort=comfort))
    controls = (keep_velocity(game.dynamics, car) + held) / game.planner.control_scale
    ahead = leader + np.outer(0.1 * np.arange(1, 6), [leader[3], 0, 0, 0])
    plans = jnp.broadcast_to(controls[:, None], (len(controls), 5, 2))
    return held[int(np.argmax(jax.vmap(rollout_reward, (None, None, 0, None))(game, car, plans, observe(ahead[None]))))]


@pytest.mark.parametrize(("gap", "speed", "leading"), [(10.0, 15.0, 13.0), (30.0, 20.0, 22.0), (6.0, 8.0, 10.0)])
def test_a_held_acceleration_is_the_best_of_the_reward(gap, speed, leading):
    traits = RewardTraits(LIMIT, 1.4, 1.3)
    held = np.stack([np.zeros(141), np.linspace(-4, 3, 141)], axis=-1)
    best = best_of_reward(np.array([0.0, 0.0, 0.0, speed]), np.array([gap + 5.0, 0.0, 0.0, leading]), traits, held)
    found = held_acceleration(WEIGHTS, traits, jnp.array(speed), Leader(*map(jnp.array, (gap, leading, True))))
    assert float(found) == pytest.approx(best[1], abs=0.15)


@pytest.mark.parametrize(("offset", "heading"), [(0.8, 0.0), (-0.5, 0.02), (0.0, -0.03)])
def test_a_held_curvature_is_the_best_of_the_reward(offset, heading):
    held = np.stack([np.linspace(-0.02, 0.02, 141), np.zeros(141)], axis=-1)
    car, leader = np.array([0.0, offset, heading, 20.0]), np.array([-900.0, 0.0, 0.0, 0.0])
    found = held_curvature(WEIGHTS, *map(jnp.array, (offset, heading, 20.0)))
    assert float(found) == pytest.approx(
        best_of_reward(car, leader, RewardTraits(LIMIT, 1.4, 1.0), held)[0], abs=1.5e-3
    )


def test_without_a_leader_only_the_desired_speed_counts():
    nobody = Leader(*map(jnp.array, (0.0, 0.0, False)))
    even, faster, slower = (
        float(held_acceleration(WEIGHTS, RewardTraits(wish, 1.0, 1.0), jnp.array(speed), nobody))
        for wish, speed in ((15.0, 15.0), (30.0, 15.0), (15.0, 20.0))
    )
    assert even == pytest.approx(0.0, abs=1e-6)
    assert slower < 0.0 < faster
