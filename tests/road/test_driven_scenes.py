"""Goals and speeds of highway-env's scenes, the robot in their car, and refused configurations; nothing is planned."""

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

import ms_highway
from ms_highway.road.robot import RoadRobot
from ms_highway.road.stock import desired_speed_of, destination_of, replace_ego

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
        ("two-way-v0", None, 30.0),
        ("racetrack-v0", None, 10.0),
    ],
)
def test_destination_and_desired_speed_are_those_of_the_scene(name, destination, speed):
    assert (destination_of(made(name)), desired_speed_of(made(name))) == (destination, speed)


def test_a_random_destination_is_the_end_of_the_route():
    env, found = made("intersection-v0", destination=None), set()
    for seed in range(6):
        env.reset(seed=seed)
        found.add(destination_of(env))
        assert destination_of(env) == env.unwrapped.vehicle.route[-1][1]
    assert len(found) > 1


def test_a_robot_replaces_the_controlled_vehicle():
    env = made("intersection-v0").unwrapped
    old, place, observed = env.vehicle, env.road.vehicles.index(env.vehicle), env.observation_type.observe()
    new = replace_ego(env, RoadRobot.create_from)
    assert env.vehicle is env.road.vehicles[place] is env.action_type.controlled_vehicle is new
    assert env.observation_type.observer_vehicle is new
    assert (new.speed, new.heading, getattr(old, "route", None)) == (old.speed, old.heading, new.route)
    np.testing.assert_array_equal(env.observation_type.observe(), observed)


def test_side_effects_of_an_intersection_on_highway_envs_drivers_are_undone_in_other_scenes():
    for name, expected in (("intersection-v0", [7, 6, -3]), ("merge-v0", [10.0, 3.0, -5.0])):
        ms_highway.drive(gym.make(name)).reset(seed=0)
        assert expected == [IDMVehicle.DISTANCE_WANTED, IDMVehicle.COMFORT_ACC_MAX, IDMVehicle.COMFORT_ACC_MIN]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"prize": 1.0}, "unknown key 'prize' in config; did you mean 'price'"),
        ({"driver": "priced:cheap"}, "'priced:cheap'; choose one of priced, .* with numbers from 0"),
        ({"driver": "fixed:tom", "ladder": ("naive", "idm")}, "'fixed:tom'; .*rungs of.*'ladder'.*'naive', 'idm'"),
    ],
)
def test_an_impossible_configuration_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        ms_highway.drive(gym.make("merge-v0"), config)


def test_without_a_road_to_follow_the_error_names_the_scenes_that_work():
    with pytest.raises(ValueError, match=r"parking-v0.*the robot drives highway, merge, roundabout"):
        ms_highway.drive(gym.make("parking-v0"))
