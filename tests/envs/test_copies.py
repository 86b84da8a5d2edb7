"""Copies of environments, as planners and workers use them, and the types in ``info`` that workers rely on."""

from copy import deepcopy
from pickle import dumps, loads

import gymnasium as gym
import jax
import numpy as np
import pytest
from episodes import PIXELS, make

import ms_highway
from ms_highway.vehicle import states_of

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

DRIVEN = "intersection-v0"
NAMES = (DRIVEN, "merger", "dense_merge", "ms-highway/demonstration-v0", "ms-highway/recorded-v0")


def made(name):
    if name == DRIVEN:
        return ms_highway.drive(gym.make(name, render_mode="rgb_array"), {"driver": "fixed:naive"})
    if "/" in name:
        return gym.make(name, render_mode="rgb_array", config={"observation": PIXELS} if "recorded" in name else None)
    return make(name, render_mode="rgb_array")


@pytest.mark.parametrize("name", NAMES)
def test_copies_of_a_rendered_environment_drive_alike_and_can_be_rendered(name):
    env = made(name)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(4):
        env.render()
        copies, action = [env, deepcopy(env), loads(dumps(env))], env.action_space.sample()
        seen = [each.step(action)[0] for each in copies]
        np.testing.assert_array_equal(seen[1:], [seen[0]] * 2)
        states = [states_of(each.unwrapped.road.vehicles) for each in copies]
        np.testing.assert_array_equal(states[1:], [states[0]] * 2)
    for each in copies[1:]:
        np.testing.assert_allclose(each.render().mean(), env.render().mean(), rtol=0.05)


@pytest.mark.parametrize("name", NAMES)
def test_each_key_of_info_has_one_type_and_shape_in_all_steps_that_have_it(name):
    env = made(name)
    infos = [env.reset(seed=0)[1], *(env.step(env.action_space.sample())[4] for _ in range(3)), env.reset(seed=1)[1]]
    kinds = {}
    for info in infos:
        for key, value in jax.tree.leaves_with_path(info, is_leaf=lambda value: not isinstance(value, dict)):
            kind = getattr(value, "dtype", type(value)), np.shape(value)
            assert kinds.setdefault(key, kind) == kind, key
    assert len(kinds) > 5
