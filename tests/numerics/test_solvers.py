"""Newton's method reaches what gradient steps miss."""

import numpy as np
import pytest
from episodes import drive, make


@pytest.mark.slow
def test_newton_passes_the_cones_of_stay_back():
    """Gradient steps collided from these seeds, the only ones of the first hundred."""
    env = make("stay_back", "turn", solver="newton", human_reward="published")
    episodes = [drive(env, seed) for seed in (39, 94)]
    assert not any(info["collision"] for episode in episodes for info in episode.infos)
    assert np.mean([episode.rewards for episode in episodes]) > 2.6
