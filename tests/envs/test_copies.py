"""Copies of environments, as planners and workers use them."""

from copy import deepcopy
from pickle import dumps, loads

import gymnasium as gym
import numpy as np
import pytest
from episodes import make

import ms_highway

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

PIXELS = {"type": "GrayscaleObservation", "observation_shape": (64, 64), "stack_size": 1, "weights": [0.3, 0.6, 0.1]}
DRIVEN = ("merge-v0", "exit-v0", "intersection-v0")
OWN = ("merger", "ms-highway/demonstration-v0", "ms-highway/recorded-v0")


def made(name):
    """An environment at the start of an episode."""
    if name in DRIVEN:
        env = ms_highway.drive(gym.make(name, render_mode="rgb_array"), {"driver": "fixed:naive"})
    elif "/" in name:
        env = gym.make(name, render_mode="rgb_array", config={"observation": PIXELS} if "recorded" in name else None)
    else:
        env = make(name, render_mode="rgb_array")
    env.reset(seed=0)
    env.action_space.seed(0)
    return env


@pytest.mark.parametrize("name", [*DRIVEN, *OWN])
def test_copies_of_a_rendered_environment_drive_alike_and_can_be_rendered(name):
    env = made(name)
    for _ in range(4):
        env.render()
        copies, action = [env, deepcopy(env), loads(dumps(env))], env.action_space.sample()
        states, seen = [], []
        for each in copies:
            seen.append(each.step(action)[0])
            states.append([[*car.position, car.heading, car.speed] for car in each.unwrapped.road.vehicles])
        np.testing.assert_array_equal(states[1:], [states[0]] * 2)
        np.testing.assert_array_equal(seen[1:], [seen[0]] * 2)
    for each in copies[1:]:
        np.testing.assert_allclose(each.render().mean(), env.render().mean(), rtol=0.05)
