"""The reference page agrees with the environments and leaves nothing out."""

import runpy
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from test_pages import REFERENCE, fences

from ms_highway.envs import ENVIRONMENTS, environment_id

PROGRAM = SimpleNamespace(**runpy.run_path(str(REFERENCE.with_name("reference.py"))))


def test_the_page_agrees_with_the_classes():
    assert REFERENCE.read_text() == PROGRAM.page(), "run `python notebooks/reference.py`"


@pytest.mark.parametrize(("name", "humans"), [("merger-v1", None), ("dense_merge", 2)])
def test_all_keys_of_info_and_of_the_configuration_are_explained(name, humans):
    config = {"controller": "switching:0.1+belief"} | ({"humans": humans, "horizon": 5} if humans else {})
    env = gym.make(environment_id(name), config=config)
    env.reset(seed=0)
    *_, info = env.step(0)
    told = {*info} - {f"humans_{model}" for model in ENVIRONMENTS[name].scenario.ladder}
    assert told <= {*PROGRAM.INFO}
    assert {*PROGRAM.configuration_keys()} == {*ENVIRONMENTS[name].default_config()} - {*PROGRAM.OF_HIGHWAY_ENV}


@pytest.mark.slow
def test_the_rollout_in_jax_of_the_page_runs():
    (_, rollout) = fences(REFERENCE, "python")
    found = {}
    exec(rollout, found)
    assert found["rewards"].shape == (8, 40)
    assert np.isfinite(found["rewards"]).all()
