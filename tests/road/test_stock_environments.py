"""Commuters as the other vehicles of stock environments."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest

from ms_highway.benchmarks.road import TRAFFIC
from ms_highway.benchmarks.road.episodes import Block, run_episode
from ms_highway.vehicle import CommuterVehicle

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

IDLE = 1
STOCK = [
    "highway-fast",
    "merge-generic",
    "two-way",
    "u-turn",
    "roundabout",
    "intersection",
    "exit",
]


def commuters_in(name, seed=0, **config):
    """A stock environment, just reset, among commuters."""
    environment = gym.make(
        name, config={"other_vehicles_type": TRAFFIC["commuter"]} | config
    ).unwrapped
    environment.reset(seed=seed)
    if name == "merge-v0":  # the ego would drive at 30 m/s and brake for nobody
        environment.vehicle.speed = environment.vehicle.target_speed = 20.0
    return environment


def drive(environment, steps):
    """Drive with an idle ego until the episode ends, and yield the commuters after each
    step.
    """
    for _ in range(steps):
        _, _, terminated, truncated, _ = environment.step(IDLE)
        yield [
            car for car in environment.road.vehicles if isinstance(car, CommuterVehicle)
        ]
        if terminated or truncated:
            return


@pytest.mark.slow
def test_a_commuter_on_a_ramp_merges_before_it_ends():
    for seed in range(3):
        environment = commuters_in("merge-v0", seed)
        merging = environment.road.vehicles[-1]
        *_, _ = drive(environment, 25)
        past_the_obstacle = 320.0  # m; it is at the end of the ramp, at 310 m
        assert merging.position[0] > past_the_obstacle
        assert merging.lane_index[:2] == ("c", "d")
        assert not merging.crashed


@pytest.mark.parametrize("name", STOCK)
def test_commuters_of_every_stock_environment_drive_within_limits_and_copy(
    name,
):
    environment = commuters_in(f"{name}-v0", policy_frequency=5)
    environment.step(IDLE)
    twin = deepcopy(environment)
    driven = 0
    for commuters in drive(environment, 6):
        for car in (car for car in commuters if not car.crashed):
            driven += 1
            assert -8.0 <= car.action["acceleration"] <= 4.0
            assert car.speed >= -1e-9
    assert driven > 0
    *_, _ = drive(twin, 6)
    for car, other in zip(environment.road.vehicles, twin.road.vehicles, strict=True):
        np.testing.assert_allclose(car.position, other.position)


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    ["highway-fast-v0", "merge-v1", "roundabout-v1", "intersection-v2", "exit-v1"],
)
def test_commuters_collide_no_more_often_than_highway_envs_drivers(
    scene,
):
    collisions = {}
    for kind in ("idm", "commuter"):
        episodes = [
            run_episode(Block(scene, kind, kind), seed) for seed in range(200, 206)
        ]
        collisions[kind] = sum(episode["collided"] for episode in episodes)
        assert all(
            episode["others_speed"] > 1.0 for episode in episodes
        )  # a car that stands never collides
    assert collisions["commuter"] <= collisions["idm"]
