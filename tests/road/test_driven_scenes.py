"""Goals and speeds of highway-env's scenes, the robot in their car, and refused
configurations; nothing is planned.
"""

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

import ms_highway
from ms_highway.road.stock import desired_speed_of, destination_of

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")


def made(name, **config):
    env = gym.make(name, config=config)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("name", "destination", "speed"),
    [
        ("roundabout-v0", "nxs", 16.0),
        ("exit-v0", "exit", 30.0),
        ("u-turn-v0", "d", 24.0),
        ("intersection-v0", "o1", 10.0),
        ("merge-v0", None, 30.0),
        ("racetrack-v0", None, 10.0),
    ],
)
def test_destination_and_desired_speed_are_those_of_the_scene(name, destination, speed):
    env = made(name)
    assert (destination_of(env), desired_speed_of(env)) == (destination, speed)


def test_a_random_destination_is_the_end_of_the_route():
    env = made("intersection-v0", destination=None)
    found = set()
    for seed in range(6):
        env.reset(seed=seed)
        found.add(destination_of(env))
        assert destination_of(env) == env.unwrapped.vehicle.route[-1][1]
    assert len(found) > 1


@pytest.mark.parametrize("name", ["intersection-v0", "intersection-multi-agent-v0"])
def test_robots_replace_controlled_vehicles_and_are_observed_like_them(name):
    stock = made(name).unwrapped
    driven = ms_highway.drive(gym.make(name))
    observed, _ = driven.reset(seed=0)
    base = driven.unwrapped
    action_type = driven.unwrapped.action_type
    observation_type = driven.unwrapped.observation_type
    np.testing.assert_equal(observation_type.observe(), observed)
    actions = getattr(action_type, "agents_action_types", [action_type])
    observations = getattr(
        observation_type, "agents_observation_types", [observation_type]
    )
    controlled = [part.controlled_vehicle for part in actions]
    observers = [part.observer_vehicle for part in observations]
    assert driven.robots == base.controlled_vehicles == controlled == observers
    for robot, old in zip(driven.robots, stock.controlled_vehicles, strict=True):
        assert robot in base.road.vehicles
        assert robot.speed == old.speed
        assert robot.heading == old.heading
        assert robot.route == getattr(old, "route", None)


def test_side_effects_of_an_intersection_are_undone_in_other_scenes():
    for name, expected in (
        ("intersection-v0", [7, 6, -3]),
        ("merge-v0", [10.0, 3.0, -5.0]),
    ):
        ms_highway.drive(gym.make(name)).reset(seed=0)
        assert expected == [
            IDMVehicle.DISTANCE_WANTED,
            IDMVehicle.COMFORT_ACC_MAX,
            IDMVehicle.COMFORT_ACC_MIN,
        ]


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        (
            "merge-v0",
            {"prize": 1.0},
            "unknown key 'prize' in config; did you mean 'price'",
        ),
        (
            "merge-v0",
            {"driver": "fixed:tom", "ladder": ("naive", "idm")},
            (
                "'fixed:tom'; choose one of priced, .* with numbers from 0 and rungs"
                " of.*'ladder'.*'naive', 'idm'"
            ),
        ),
        ("parking-v0", {}, r"parking-v0.*the robot drives highway, merge, roundabout"),
    ],
)
def test_what_cannot_be_driven_is_refused_with_a_remedy(name, config, message):
    with pytest.raises(ValueError, match=message):
        ms_highway.drive(gym.make(name), config)
