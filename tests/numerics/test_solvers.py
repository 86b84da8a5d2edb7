"""Solvers reach what gradient steps miss."""

import jax
import numpy as np
import pytest
from episodes import drive, make
from jax import numpy as jnp

from ms_highway.numerics.newton import Objective
from ms_highway.numerics.solvers import Planner, optimize_controls


def test_newton_climbs_a_steep_hill_that_gradient_steps_overshoot():
    top, steep = jnp.array([[0.5, -0.2], [0.1, 0.3]]), jnp.array([400.0, 1.0])

    def reward(path):
        return -jnp.sum(steep * (path.T - top) ** 2)

    hill = Objective(
        lambda controls: controls.T,
        reward,
        lambda controls: 0.0 * jnp.sum(controls),
        lambda controls: controls,
        jax.grad(reward),
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
        env = make("stay_back", "turn", solver=solver, human_reward="published")
        episodes = [drive(env, seed) for seed in (39, 94)]
        collides = any(info["collision"] for episode in episodes for info in episode.infos)
        driven[solver] = collides, np.mean([episode.rewards for episode in episodes])
    assert driven["gradient"][0]
    assert not driven["newton"][0]
    assert driven["newton"][1] > max(2.6, driven["gradient"][1])
