"""Import, drive, plan and simulate: what has to work with the oldest and the newest versions, and in the wheel."""

import gymnasium as gym
import numpy as np
import pytest

import ms_highway
from ms_highway.cli.main import main

COSTS = {"naive": 0.001, "turn": 0.002, "tom": 0.01}  # s


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")  # also where there is no pyproject.toml
@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("merger", {"controller": {"type": "learned", "lambda": 1.0}}),
        (
            "dense-merge",
            {
                "controller": {"type": "fixed", "model": "naive"},
                "costs": COSTS,
                "humans": 2,
                "horizon": 5,
                "solver": "gradient",
            },
        ),
    ],
)
def test_the_robot_drives_and_plans(name, config):
    env = gym.make(f"ms-highway/{name}-v0", render_mode="rgb_array", config=config)
    observation, info = env.reset(seed=0)
    for _ in range(3):
        observation, reward, _, _, info = env.step(0)
    assert env.observation_space.contains(observation)
    assert np.isfinite(reward)
    assert info["status"] == "planned"
    assert env.render().any()
    robot, _ = ms_highway.plan(env.unwrapped.game, env.unwrapped.car_states, "naive")
    assert robot.shape == (5, 2)


def test_the_command_simulates_episodes(tmp_path):
    pytest.importorskip("pyarrow")
    controllers = ["--controllers", "naive", "--seeds", "2", "--devices", "1"]
    assert not main(["sweep", "merger", *controllers, "--out", str(tmp_path)])
    assert (tmp_path / "summary.csv").read_text().count("\n") == 2
