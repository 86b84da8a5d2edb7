"""Importing, driving, planning and simulating work with the oldest and newest versions,
and from the wheel.
"""

import gymnasium as gym
import numpy as np
import pytest

import ms_highway
from ms_highway.cli.main import main

OURS = sorted(
    name
    for name in gym.registry
    if name.startswith("ms-highway/") and name != "ms-highway/recorded-v0"
)


@pytest.mark.filterwarnings(
    "ignore:.*is out of date:DeprecationWarning"
)  # also where there is no pyproject.toml
@pytest.mark.parametrize("name", OURS)  # all but the one that needs a recording
def test_every_environment_is_reset_stepped_and_drawn(name):
    driven = "demonstration" not in name
    small = {"ladder": ["naive"]} if "dense-merge-v0" in name else {}
    env = gym.make(
        name,
        render_mode="rgb_array",
        config={"controller": "naive", **small} if driven else {},
    )
    env.reset(seed=0)
    for _ in range(2):
        observation, reward, _, _, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert np.isfinite(reward)
    assert env.render().any()
    assert not driven or info["status"] == "planned"


def test_learned_values_decide_and_a_single_plan_can_be_made():
    env = gym.make("ms-highway/merger-v1")
    env.reset(seed=0)
    for _ in range(2):
        *_, info = env.step(0)
    assert np.isfinite(list(info["gains"].values())).any()
    robot, humans = ms_highway.plan(
        env.unwrapped.game, env.unwrapped.car_states, "naive"
    )
    assert (robot.shape, humans.shape) == ((10, 2), (1, 10, 2))


def test_the_command_simulates_episodes(tmp_path):
    pytest.importorskip("pyarrow")
    command = "sweep merger --controllers naive --seeds 2 --devices 1"
    assert not main([*command.split(), "--out", str(tmp_path)])
    assert (tmp_path / "summary.csv").read_text().count("\n") == 2
