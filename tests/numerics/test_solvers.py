"""Solvers reach what gradient steps miss."""

from functools import partial

import jax
import numpy as np
import pytest
from episodes import drive, make
from jax import numpy as jnp

from ms_highway.numerics.newton import Objective
from ms_highway.numerics.solvers import Planner, optimize_controls


def test_newton_climbs_a_steep_hill():
    """A gradient step of 0.03 would multiply the distance from the top by -23."""
    top, steep = np.float32([[0.5, -0.2], [0.1, 0.3]]), np.float32([400.0, 1.0])

    def reward(path):
        return -jnp.sum(steep * (path - top) ** 2)

    hill = Objective(lambda path: path, reward, lambda path: 0.0, lambda path: path, jax.grad(reward))
    planner = Planner(np.ones(2), np.full(2, np.inf), solver="newton")
    climb = jax.jit(partial(optimize_controls, planner, hill))
    reached = np.asarray(climb(np.zeros((2, 2), np.float32)))
    np.testing.assert_allclose(reached[:, 0], top[:, 0], atol=1e-4)
    assert reward(reached) > -0.02
    assert np.isnan(climb(np.full((2, 2), np.nan, np.float32))).all()  # so that the plan fails, and says so


@pytest.mark.slow
def test_newton_passes_the_cones_of_stay_back():
    """Gradient steps collided from these seeds, the only ones of the first hundred."""
    env = make("stay_back", "turn", solver="newton", human_reward="published")
    episodes = [drive(env, seed) for seed in (39, 94)]
    assert not any(info["collision"] for episode in episodes for info in episode.infos)
    assert np.mean([episode.rewards for episode in episodes]) > 2.6
