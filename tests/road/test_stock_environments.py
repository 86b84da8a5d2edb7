"""Human drivers as the other vehicles of stock environments."""

from copy import deepcopy

import gymnasium as gym
import jax
import numpy as np
import pytest
from episodes import drives_long
from highway_env.vehicle.behavior import IDMVehicle

from ms_highway.road.stock import replace_ego
from ms_highway.vehicle import HumanVehicle
from ms_highway.vehicle.bicycle import OfferedSpeeds

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

IDLE = 1
STOCK = ["highway-fast", "merge-generic", "two-way", "u-turn", "roundabout", "intersection", "exit"]


def humans_in(name, seed=0, **config):
    """A stock environment, just reset, among human drivers."""
    config = {"other_vehicles_type": "ms_highway.vehicle.HumanVehicle"} | config
    environment = gym.make(name, config=config).unwrapped
    environment.reset(seed=seed)
    if name == "merge-v0":  # the ego would drive at 30 m/s and brake for nobody
        environment.vehicle.speed = environment.vehicle.target_speed = 20.0
    return environment


def drive(environment, steps):
    """Drive with an idle ego until the episode ends, and yield the humans after each step."""
    for _ in range(steps):
        _, _, terminated, truncated, _ = environment.step(IDLE)
        yield [car for car in environment.road.vehicles if isinstance(car, HumanVehicle)]
        if terminated or truncated:
            return


@drives_long
@pytest.mark.parametrize(("name", "config"), [("highway-v0", {"vehicles_count": 10}), ("merge-v0", {})])
def test_humans_drive_episodes_of_stock_environments_and_compile_nothing_after_the_first_step(name, config, caplog):
    driven = []
    with jax.log_compiles():
        for seed in range(2):
            for humans in drive(humans_in(name, seed, **config), 10):
                if not driven:
                    caplog.clear()
                driven += humans
                assert {human.last_step.status for human in humans} == {"planned"}
                assert all(human.on_road and not human.crashed for human in humans)
    assert not [record for record in caplog.records if "compilation" in record.getMessage()]
    assert len(driven) > 2 * 4 * 8


@drives_long
@pytest.mark.parametrize("kind", ["HumanVehicle", "CommuterVehicle"])
def test_a_human_on_a_ramp_merges_before_it_ends(kind):
    for seed in range(3):
        environment = humans_in("merge-v0", seed, other_vehicles_type=f"ms_highway.vehicle.{kind}")
        merging = environment.road.vehicles[-1]
        *_, _ = drive(environment, 25)
        assert merging.position[0] > 320.0  # past the obstacle at the end of the ramp, at 310 m
        assert merging.lane_index[:2] == ("c", "d")
        assert not merging.crashed


@pytest.mark.parametrize("name", STOCK)
def test_in_every_stock_environment_humans_plan_within_tyres_never_reverse_and_can_be_copied(name):
    environment, planned = humans_in(f"{name}-v0", policy_frequency=5), 0
    environment.step(IDLE)
    twin = deepcopy(environment)
    for humans in drive(environment, 6):
        for human in (human for human in humans if human.last_step and not human.crashed):
            planned += 1
            assert human.last_step.status == "planned"
            curvature, acceleration = human.control
            total = np.hypot(human.speed**2 * curvature, acceleration - 0.2 * human.speed)
            assert total < 8.0 * 1.1  # the speed is that after it
            assert human.speed >= -1e-9
    assert planned > 0
    *_, _ = drive(twin, 6)
    for car, other in zip(environment.road.vehicles, twin.road.vehicles, strict=True):
        np.testing.assert_allclose(car.position, other.position)


def collisions(name, kind, seeds):
    """Number of episodes with a collision if all cars, the ego included, are of one kind."""
    environment, found = humans_in(name, other_vehicles_type=f"{kind.__module__}.{kind.__name__}"), 0
    for seed in range(seeds):
        environment.reset(seed=seed)
        replace_ego(environment, type("Ego", (OfferedSpeeds, kind), {}).create_from)
        *_, _ = drive(environment, 15)
        found += any(car.crashed for car in environment.road.vehicles)
    return found


@drives_long
@pytest.mark.parametrize("name", ["roundabout-v0", "intersection-v0"])
def test_humans_among_themselves_collide_less_often_than_highway_envs_drivers(name):
    assert collisions(name, HumanVehicle, 4) < collisions(name, IDMVehicle, 4)
