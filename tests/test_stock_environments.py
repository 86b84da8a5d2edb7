"""Human drivers as the other vehicles of highway-env's own environments."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest

from ms_highway.compiled import plan_function
from ms_highway.human_models import Naive
from ms_highway.vehicle import HumanVehicle

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

IDLE = 1


def humans_in(name, seed, **config):
    """A stock environment, just reset, among human drivers."""
    config = {"other_vehicles_type": "ms_highway.vehicle.HumanVehicle"} | config
    environment = gym.make(name, config=config).unwrapped
    environment.reset(seed=seed)
    return environment


def drive(environment, steps):
    """Drive with an idle ego until the episode ends; the humans after each step."""
    for _ in range(steps):
        _, _, terminated, truncated, _ = environment.step(IDLE)
        yield [car for car in environment.road.vehicles if isinstance(car, HumanVehicle)]
        if terminated or truncated:
            return


@pytest.fixture
def layouts(monkeypatch):
    """The layouts of the games of which plans have been asked for, nothing being compiled yet."""
    seen = set()

    def watched(model, layout):
        seen.add(layout)
        return plan_function(model, layout)

    monkeypatch.setattr("ms_highway.controller.plan_function", watched)
    return seen


def test_humans_drive_twenty_episodes_of_stock_environments_with_one_compilation(layouts):
    episodes = [("highway-v0", {"vehicles_count": 10, "duration": 10}, 10), ("merge-v0", {}, 12)]
    plan_function.cache_clear()  # what other tests have compiled, with other settings of JAX, does not count
    driven = 0
    for name, config, steps in episodes:
        for seed in range(10):
            for humans in drive(humans_in(name, seed, **config), steps):
                driven += len(humans)
                for human in humans:
                    assert human.last_step.status == "planned"
                    assert np.isfinite(human.state).all()
                    assert human.on_road
                    assert not human.crashed
    assert driven > 10 * 10 * 10 + 10 * 4 * 8
    (layout,) = layouts
    assert plan_function(Naive(), layout)._cache_size() == 1


@pytest.mark.parametrize("kind", ["HumanVehicle", "CommuterVehicle"])
def test_a_human_on_a_ramp_merges_before_it_ends(kind):
    for seed in range(3):
        environment = humans_in("merge-v0", seed, other_vehicles_type=f"ms_highway.vehicle.{kind}")
        merging = environment.road.vehicles[-1]
        *_, _ = drive(environment, 25)
        assert merging.position[0] > 320.0  # where the ramp ends there is an obstacle, at 310 m
        assert merging.lane_index[:2] == ("c", "d")
        assert not merging.crashed


STOCK = [
    "highway-fast",
    "merge-generic",
    "two-way",
    "u-turn",
    "roundabout",
    "roundabout-generic",
    "intersection",
    "exit",
]


@pytest.mark.parametrize("name", STOCK)
def test_humans_plan_in_every_stock_environment(name):
    planned = 0
    for humans in drive(humans_in(f"{name}-v0", 0), 5):
        planned += len(humans)
        assert all(np.isfinite(human.state).all() for human in humans)
        assert {human.last_step.status for human in humans if human.last_step} <= {"planned"}
    assert planned > 0


def test_an_environment_with_humans_in_it_can_be_copied():
    environment = humans_in("highway-v0", 0, vehicles_count=3, duration=4)
    environment.step(IDLE)
    twin = deepcopy(environment)
    for _ in range(2):
        environment.step(IDLE)
        twin.step(IDLE)
    for car, other in zip(environment.road.vehicles, twin.road.vehicles, strict=True):
        np.testing.assert_allclose(car.position, other.position)
