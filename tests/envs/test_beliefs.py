"""Beliefs about the model of each human: how they are inferred, used and shown."""

import numpy as np
import pytest
from episodes import drive, make

from ms_highway.envs.colors import model_color
from ms_highway.envs.graphics import PANEL_LAYOUT
from ms_highway.planning.ladders import PACKAGE_MODELS

SEED = 3


@pytest.fixture(scope="module")
def trusted():
    """An episode of a robot with a belief and a human that yields."""
    return drive(make("merger", "tom+belief"), SEED)


def test_a_human_that_yields_is_recognised_and_trusted(trusted):
    beliefs = np.array([info["belief"] for info in trusted.infos])
    assert beliefs.shape == (40, 1, 4)
    np.testing.assert_allclose(beliefs.sum(axis=-1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(beliefs[0], 1 / 4)  # before anything was seen
    places = [PACKAGE_MODELS.index(name) for name in ("turn", "tom")]
    assert (beliefs[3:, 0, places].sum(axis=-1) > 0.85).all()
    assert trusted.states[-1, 0, 1] < -2.5  # in its lane


def test_a_belief_in_a_yielding_human_changes_only_info(trusted):
    _, states, _, infos = drive(make("merger", "tom"), SEED)
    np.testing.assert_array_equal(states, trusted.states)
    assert not any("belief" in info for info in infos)
    assert all(info["timing"].decision_seconds == 0 for info in infos)
    assert all(info["timing"].decision_seconds > 0 for info in trusted.infos[1:])


def test_a_belief_keeps_the_robot_behind_unyielding_humans():
    env = make("merger", "learned:1+belief", yielding="never")
    _, states, _, infos = drive(env, SEED)
    assert infos[5]["belief"][0, PACKAGE_MODELS.index("naive")] > 0.95
    assert {info["model"] for info in infos[5:]} == {"naive"}
    assert not any(info["collision"] for info in infos)
    assert (states[:, 0, 1] > -1.25).all()  # within its own lane


def test_a_frame_shows_every_humans_belief():
    def shown(controller):
        env = make("dense_merge", controller, "rgb_array")
        drive(env, steps=1)
        picture = env.render()
        height = env.unwrapped.viewer.panel_height
        panel = picture[-height:, : PANEL_LAYOUT.text_width]
        return int((panel == model_color("idm")).all(axis=-1).sum())

    assert shown("naive") < 500 < shown("naive+belief")
