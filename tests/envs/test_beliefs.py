"""Which model is this human? What a robot infers, in whom it trusts, and what is shown of it."""

import numpy as np
import pytest
from episodes import TWO, drive, make

from ms_highway.envs.graphics import TEXT_WIDTH
from ms_highway.envs.viewer import model_color

NAIVE, IDM, TURN, TOM = range(4)
SEED = 3


@pytest.fixture(scope="module")
def trusted():
    """A robot that infers, and a human that yields."""
    return drive(make("merger", "tom+belief"), SEED)


def test_a_human_that_yields_is_recognised_and_trusted(trusted):
    beliefs = np.array([info["belief"] for info in trusted.infos])
    assert beliefs.shape == (40, 1, 4)
    np.testing.assert_allclose(beliefs.sum(axis=-1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(beliefs[0], 1 / 4)  # nothing was seen
    assert (beliefs[3:, 0, [TURN, TOM]].sum(axis=-1) > 0.85).all()
    assert trusted.states[-1, 0, 1] < -2.5  # in its lane


def test_trust_changes_nothing_and_without_a_belief_info_has_none(trusted):
    _, states, _, infos = drive(make("merger", "tom"), SEED)
    np.testing.assert_array_equal(states, trusted.states)
    assert not any("belief" in info for info in infos)
    assert all(info["timing"].decision_seconds == 0 for info in infos)
    assert all(info["timing"].decision_seconds > 0 for info in trusted.infos[1:])


@pytest.mark.parametrize("controller", ["tom", "learned:1"])
def test_nobody_merges_in_front_of_a_human_who_ignored_the_nudge(controller):
    _, states, _, infos = drive(make("merger", f"{controller}+belief", yielding="never"), SEED)
    assert infos[5]["belief"][0, NAIVE] > 0.95
    assert {info["model"] for info in infos[5:]} == {"naive"}
    assert not any(info["collision"] for info in infos)
    assert (states[:, 0, 1] > -1.25).all()  # within its own lane


def test_who_counts_on_such_a_human_collides():
    *_, infos = drive(make("merger", "tom", yielding="never"), SEED, steps=15)
    assert any(info["collision"] for info in infos)


def test_who_never_yields_keeps_its_velocity_and_who_always_does_brakes_for_a_robot_beside_it():
    _, states, _, infos = drive(make("merger", "tom", yielding="never"), SEED, steps=10)
    np.testing.assert_allclose(states[:, 1, 2:], np.tile(states[0, 1, 2:], (11, 1)), atol=1e-4)
    assert infos[-1]["human_status"] == ("planned",)
    _, states, *_ = drive(make("merger", yielding="always"), SEED, steps=10)
    np.testing.assert_allclose(np.diff(states[:, 1, 3]), -0.3)
    assert states[-1, 0, 1] > -1.25  # the robot is still in the other lane


def test_humans_who_keep_their_velocity_brake_for_slower_ones_but_not_for_the_robot():
    starts = np.array([[12.0, -3.3, 0, 15], [0, -3.3, 0, 20], [30, -3.3, 0, 10]])
    _, states, *_ = drive(make("dense_merge", yielding="never"), starts=starts, steps=1)
    assert 20 > states[1, 1, 3] > 19.5  # 2 m/s^2 for the slower human, not 5 for the robot
    assert states[1, 2, 3] == pytest.approx(10.0)


def test_mixed_humans_are_drawn_for_every_episode():
    env = make("dense_merge", yielding="mixed", humans=12).unwrapped

    def drawn(seed):
        env.reset(seed=seed)
        return [car.controller.yields for car in env.humans]

    assert drawn(0) == drawn(0) != drawn(1)
    assert {*drawn(0)} == {True, False}


@pytest.mark.parametrize(("scenario", "config"), [("merger", {}), ("dense_merge", TWO)])
def test_a_frame_shows_every_humans_belief(scenario, config):
    def shown(controller):
        env = make(scenario, controller, "rgb_array", **config)
        drive(env, steps=1)
        panel = env.render()[-env.unwrapped.viewer.panel_height :, :TEXT_WIDTH]
        return int((panel == model_color("idm")).all(axis=-1).sum())

    assert shown("naive") < 500 < shown("naive+belief")
