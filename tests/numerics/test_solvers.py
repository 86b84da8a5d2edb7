"""Solvers reach what gradient steps miss."""

import gymnasium as gym
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.numerics.objective import Objective
from ms_highway.numerics.solvers import Planner, optimize_controls


def test_newton_climbs_a_steep_hill_that_gradient_steps_overshoot():
    top, steep = jnp.array([[0.5, -0.2], [0.1, 0.3]]), jnp.array([400.0, 1.0])
    hill = Objective(
        lambda controls: jnp.concatenate([controls.T, jnp.zeros((3, len(controls)))]),
        lambda path: -jnp.sum(steep * (path[:2].T - top) ** 2),
        lambda controls: 0.0 * jnp.sum(controls),
        lambda controls: controls,
    )
    reached = {
        solver: optimize_controls(Planner(np.ones(2), np.full(2, np.inf), solver=solver), hill, jnp.zeros((2, 2)))
        for solver in ("gradient", "newton")
    }
    assert not abs(reached["gradient"]).max() < 10  # it has left the hill
    np.testing.assert_allclose(reached["newton"][:, 0], top[:, 0], atol=1e-4)
    assert hill.earned(reached["newton"]) > -0.02


@pytest.mark.slow
def test_newton_passes_the_cones_of_stay_back_where_gradient_steps_collide():
    """Seeds 39 and 94 are those of the first hundred in which gradient steps collide."""
    driven = {}
    for solver in ("gradient", "newton"):
        controller = {"type": "fixed", "model": "turn"}
        config = {"controller": controller, "solver": solver, "human_reward": "published"}
        env = gym.make("ms_highway:ms-highway/stay-back-v0", config=config)
        collisions, rewards = [], []
        for seed in (39, 94):
            env.reset(seed=seed)
            done = False
            while not done:
                _, reward, terminated, truncated, info = env.step(0)
                done = terminated or truncated
                collisions.append(info["collision"])
                rewards.append(reward)
        driven[solver] = any(collisions), np.mean(rewards)
    assert driven["gradient"][0]
    assert not driven["newton"][0]
    assert driven["newton"][1] > max(2.6, driven["gradient"][1])
