"""The reference page agrees with the environments and leaves nothing out."""

import runpy
from types import SimpleNamespace

import numpy as np
import pytest
from episodes import make
from test_pages import REFERENCE, fences

from ms_highway.envs import ENVIRONMENTS

PROGRAM = SimpleNamespace(**runpy.run_path(str(REFERENCE.with_name("reference.py"))))


def test_the_page_agrees_with_the_classes():
    assert REFERENCE.read_text() == PROGRAM.page(), (
        "run `python notebooks/reference.py`"
    )


def test_exactly_the_keys_of_info_are_explained():
    told = set()
    for name, controller in (
        ("stay_back", "naive"),
        ("merger", "naive+belief"),
        ("dense_merge", "naive"),
    ):
        env = make(name, controller)
        env.reset(seed=0)
        told |= {*env.step(0)[-1]}
    likewise = {"humans_turn", "humans_tom"}  # explained by the row of humans_idm
    assert likewise <= told
    assert told - likewise == {*PROGRAM.INFO} - {"humans_idm"}


def test_exactly_the_keys_of_the_configuration_are_explained():
    explained = {*PROGRAM.configuration_keys()}
    for environment in ENVIRONMENTS.values():
        assert explained == {*environment.default_config()} - {*PROGRAM.OF_HIGHWAY_ENV}


@pytest.mark.slow
def test_the_rollout_in_jax_of_the_page_runs():
    _, rollout = fences(REFERENCE, "python")
    found = {}
    exec(rollout, found)
    assert found["rewards"].shape == (8, 40)
    assert np.isfinite(found["rewards"]).all()
