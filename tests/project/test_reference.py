"""The reference page says what the environments do, and leaves nothing out."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from test_pages import REFERENCE, fences

from ms_highway.envs import ENVIRONMENTS, environment_id

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


@pytest.fixture(scope="module")
def reference():
    spec = spec_from_file_location("reference", NOTEBOOKS / "reference.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    sys.modules.pop("reference", None)


def test_the_page_is_what_the_classes_say(reference):
    message = "run `python notebooks/reference.py`"
    assert (NOTEBOOKS / "REFERENCE.md").read_text() == reference.page(), message


@pytest.mark.parametrize(("name", "humans"), [("merger-v1", None), ("dense_merge", 2)])
def test_all_that_a_step_tells_is_explained(reference, name, humans):
    config = {"controller": "switching:0.1+belief"} | ({"humans": humans, "horizon": 5} if humans else {})
    env = gym.make(environment_id(name), config=config)
    env.reset(seed=0)
    *_, info = env.step(0)
    told = {*info} - {f"humans_{model}" for model in ENVIRONMENTS[name].scenario.ladder}
    assert told <= {*reference.INFO}
    assert {*reference.configuration_keys()} == {*ENVIRONMENTS[name].default_config()} - {*reference.OF_HIGHWAY_ENV}


@pytest.mark.slow
def test_the_rollout_in_jax_of_the_page_runs():
    (_, rollout) = fences(REFERENCE, "python")
    found = {}
    exec(rollout, found)
    assert found["rewards"].shape == (8, 40)
    assert np.isfinite(found["rewards"]).all()
