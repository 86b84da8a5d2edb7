"""Copies of environments, as planners and workers use them, and the types in ``info``
that workers rely on.
"""

import warnings
from copy import deepcopy
from functools import partial
from pickle import dumps, loads

import gymnasium as gym
import numpy as np
import pytest
from episodes import PIXELS, TWO, form, make

import ms_highway
from ms_highway.experiments.runner import make_environment
from ms_highway.vehicle import states_of

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

DRIVEN = "intersection-v0"
NAMES = (
    DRIVEN,
    "merger",
    "dense_merge",
    "ms-highway/demonstration-v0",
    "ms-highway/recorded-v0",
)


def made(name):
    if name == DRIVEN:
        return ms_highway.drive(
            gym.make(name, render_mode="rgb_array"), {"driver": "fixed:naive"}
        )
    if "/" in name:
        return gym.make(
            name,
            render_mode="rgb_array",
            config={"observation": PIXELS} if "recorded" in name else None,
        )
    return make(name, render_mode="rgb_array")


@pytest.mark.parametrize("name", NAMES)
def test_copies_of_a_rendered_environment_drive_and_render_alike(name):
    env = made(name)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(4):
        env.render()
        copies = [env, deepcopy(env), loads(dumps(env))]
        action = env.action_space.sample()
        seen = [each.step(action)[0] for each in copies]
        np.testing.assert_array_equal(seen[1:], [seen[0]] * 2)
        states = [states_of(each.unwrapped.road.vehicles) for each in copies]
        np.testing.assert_array_equal(states[1:], [states[0]] * 2)
    for each in copies[1:]:
        np.testing.assert_allclose(each.render().mean(), env.render().mean(), rtol=0.05)


CHOOSING = {
    "action": {"type": "HumanModelAction", "lambda": 1.0},
    "ladder": ["naive", "turn"],
}
DRIVING = {"action": {"type": "ContinuousAction"}}


def driven_by_an_agent():
    ms_highway.add_agent("idle", lambda observation: [0.0, 0.0])
    return make_environment("dense_merge", "idle", **TWO)


@pytest.mark.parametrize(
    "made",
    [
        *(pytest.param(partial(made, name), id=name) for name in NAMES),
        partial(
            make,
            "merger",
            "switching:0.1+belief",
            costs="measured",
            ladder=["naive", "turn"],
        ),
        partial(make, "merger", **CHOOSING),
        partial(make, "merger", "never"),
        partial(make, "merger-v1", **DRIVING, yielding="never"),
        partial(make, "dense_merge", "nearest:1", yielding="mixed"),
        partial(make, "dense_merge", **CHOOSING),
        driven_by_an_agent,
    ],
)
def test_info_has_the_same_form_from_the_reset_on(made):
    env = made()
    first = env.reset(seed=0)[1]
    infos = [
        *(env.step(env.action_space.sample())[4] for _ in range(3)),
        env.reset(seed=1)[1],
    ]
    assert len(form(first)) > 5
    for info in infos:
        assert form(info) == form(first)


@pytest.mark.parametrize(
    "made",
    [
        partial(make, "merger", "switching:0.1+belief", ladder=["naive", "turn"]),
        partial(make, "dense_merge", **CHOOSING),
        partial(make, "merger", **DRIVING),
        partial(gym.make, "ms-highway/demonstration-v0"),
    ],
)
def test_minari_records_everything_in_info(made, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Minari asks for descriptions of data sets
        env = minari.DataCollector(made(), record_infos=True)
        first = env.reset(seed=0)[1]
        for _ in range(2):
            env.step(env.action_space.sample())
        recorded = env.create_dataset("test-v0")
    (episode,) = recorded.iterate_episodes()
    assert {*episode.infos} == {*first}
    assert len(episode.infos["speed"]) == 3
