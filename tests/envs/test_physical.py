"""Scenarios at version 1, in which all cars keep to what tyres hold."""

import gymnasium as gym
import numpy as np
import pytest
from episodes import drive, make

from ms_highway.envs import SCENARIOS
from ms_highway.game.scenario import GRIP, title

PHYSICAL = [name for name, scenario in SCENARIOS.items() if scenario.semantics == "physical"]


@pytest.mark.parametrize("name", PHYSICAL)
def test_gymnasium_makes_the_physical_version_where_none_is_named(name):
    with pytest.warns(UserWarning, match="Using the latest versioned environment"):
        env = gym.make(f"ms-highway/{name.removesuffix('-v1')}")
    assert env.spec.id == f"ms-highway/{name}"
    assert env.unwrapped.config["semantics"] == "physical"
    assert title(name).endswith(" v1")


def test_robot_and_human_accelerate_by_no_more_than_tyres_hold_in_any_step():
    _, states, _, infos = drive(make("merger-v1"))
    assert {info["status"] for info in infos} == {"planned"}
    velocity = states[..., 3:] * np.stack([np.cos(states[..., 2]), np.sin(states[..., 2])], axis=-1)
    accelerations = np.linalg.norm(np.diff(velocity, axis=0), axis=-1) / 0.1
    assert 4.0 < accelerations[:, :2].max() < GRIP + 0.01


def test_physical_semantics_limit_a_scenario_of_the_paper_too():
    planner = make("merger", semantics="physical").unwrapped.game.planner
    assert (float(planner.grip), planner.horizon) == (GRIP, 5)
