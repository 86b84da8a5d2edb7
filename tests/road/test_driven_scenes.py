"""What the robot is told of highway-env's scenes, and what it refuses; nothing is planned here."""

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

import ms_highway
from ms_highway.road.robot import RoadRobot
from ms_highway.road.stock import desired_speed_of, destination_of, replace_ego

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

VALUES = "DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN"


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
def test_where_to_and_how_fast_is_what_the_scene_asks_for(name, destination, speed):
    assert (destination_of(made(name)), desired_speed_of(made(name))) == (destination, speed)


def test_a_destination_that_is_drawn_is_the_end_of_the_route():
    env, found = made("intersection-v0", destination=None), set()
    for seed in range(6):
        env.reset(seed=seed)
        found.add(destination_of(env))
        assert destination_of(env) == env.unwrapped.vehicle.route[-1][1]
    assert len(found) > 1


def test_another_vehicle_takes_the_place_of_the_controlled_one():
    env = made("intersection-v0").unwrapped
    old, place, observed = env.vehicle, env.road.vehicles.index(env.vehicle), env.observation_type.observe()
    new = replace_ego(env, RoadRobot.create_from)
    assert env.vehicle is env.road.vehicles[place] is env.action_type.controlled_vehicle is new
    assert env.observation_type.observer_vehicle is new
    assert old not in env.road.vehicles
    assert (new.speed, new.heading, getattr(old, "route", None)) == (old.speed, old.heading, new.route)
    np.testing.assert_array_equal(env.observation_type.observe(), observed)


def test_what_an_intersection_does_to_highway_envs_drivers_is_undone_in_other_scenes():
    for name, expected in (("intersection-v0", [7, 6, -3]), ("merge-v0", [10.0, 3.0, -5.0])):
        ms_highway.drive(gym.make(name)).reset(seed=0)
        assert [getattr(IDMVehicle, value) for value in VALUES] == expected


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


def test_where_there_is_no_road_to_follow_the_error_says_what_works():
    with pytest.raises(ValueError, match=r"parking-v0.*the robot drives highway, merge, roundabout"):
        ms_highway.drive(gym.make("parking-v0"))
