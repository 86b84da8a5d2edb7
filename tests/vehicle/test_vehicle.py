"""Vehicles with the paper's dynamics, and cars that plan."""

import gymnasium as gym
import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork
from highway_env.utils import are_polygons_intersecting

from ms_highway.game.dynamics import step
from ms_highway.vehicle import (
    BicycleVehicle,
    CommuterVehicle,
    HumanVehicle,
    ScriptedVehicle,
)


def road_with(*cars, lanes=2):
    """A straight road with cars, each given by class, position, speed and, optionally,
    heading.
    """
    road = Road(
        RoadNetwork.straight_road_network(lanes, speed_limit=20.0),
        np_random=np.random.RandomState(0),
    )
    for kind, position, speed, *heading in cars:
        road.vehicles.append(kind(road, list(position), *(heading or [0.0]), speed))
    return road, *road.vehicles


def drive(road, steps, dt=0.1):
    """The first car's speeds before and after each step."""
    speeds = [road.vehicles[0].speed]
    for _ in range(steps):
        road.act()
        road.step(dt)
        speeds.append(road.vehicles[0].speed)
    return speeds


def test_a_bicycle_vehicle_moves_like_the_dynamics_of_games():
    _, car = road_with((BicycleVehicle, (0.0, 0.0), 18.0, 0.1))
    before = car.state
    control = np.array([np.tan(0.05) / 5.0, 2.0])
    car.execute(control)
    assert car.action == pytest.approx({"steering": 0.05, "acceleration": 2.0})
    car.act(car.action)
    car.step(0.1)
    np.testing.assert_allclose(
        car.state, step(car.dynamics, before, control), atol=1e-12
    )
    assert car.state.dtype == np.float64


def test_cars_that_are_not_solid_are_hit_if_bodies_overlap():
    random = np.random.default_rng(0)
    still = np.zeros(2)
    hits = []
    for _ in range(100):
        car = BicycleVehicle(
            None, random.uniform(-1, 1, 2), random.uniform(-4, 4), speed=20.0
        )
        other = BicycleVehicle(None, random.uniform(-5, 5, 2), random.uniform(-4, 4))
        car.solid = other.solid = False
        overlap, *_ = are_polygons_intersecting(
            car.polygon(), other.polygon(), still, still
        )
        car.handle_collisions(other, 0.1)
        assert car.hit == other.hit == overlap
        assert not car.crashed
        hits.append(overlap)
    assert 0.2 < np.mean(hits) < 0.8


# Gaps are between bumpers; at 20 m/s, they are the quartiles of drivers on US-101.
@pytest.mark.parametrize(
    ("leader_speed", "gaps"), [(0.0, (1, 6)), (20.0, (16.9, 34.8))]
)
def test_commuters_keep_their_distance_behind_a_car(leader_speed, gaps):
    cars = (
        (CommuterVehicle, (0.0, 0.0), 20.0),
        (ScriptedVehicle, (35.0, 0.0), leader_speed),
    )
    road, car, leader = road_with(*cars, lanes=1)
    drive(road, 250)
    assert not car.crashed
    assert car.speed == pytest.approx(leader_speed, abs=1.0)
    assert gaps[0] < leader.position[0] - car.position[0] - car.LENGTH < gaps[1]


def test_a_commuter_stops_within_its_grip_until_it_may_drive():
    road, car = road_with((CommuterVehicle, (0.0, 0.0), 15.0))
    car.target_speed = 0
    speeds = drive(road, 90, 1 / 15)
    assert abs(np.diff(speeds)).max() <= 8.0 / 15 + 1e-9
    assert min(speeds) >= -1e-9
    assert speeds[-1] == pytest.approx(0.0, abs=0.1)
    car.target_speed = 20.0
    assert drive(road, 15, 1 / 15)[-1] > 1.5


def test_a_commuter_drives_up_to_a_standing_car():
    # Speeds are whole numbers, of type int.
    cars = ((CommuterVehicle, (0.0, 0.0), 0), (ScriptedVehicle, (35.0, 0.0), 0))
    road, car, leader = road_with(*cars, lanes=1)
    car.target_speed = 20
    drive(road, 150, 1 / 15)
    assert 1.0 < leader.position[0] - car.position[0] - car.LENGTH < 6.0


def test_a_human_without_a_controller_names_the_commuter():
    road, _ = road_with((HumanVehicle, (0.0, 0.0), 15.0))
    with pytest.raises(
        ValueError, match=r"drive_with, or use ms_highway.vehicle.CommuterVehicle"
    ):
        road.act()
    config = {"other_vehicles_type": "ms_highway.vehicle.HumanVehicle"}
    environment = gym.make("highway-fast-v0", config=config)
    environment.reset(seed=0)
    with pytest.raises(
        ValueError, match=r"CommuterVehicle, which drives on any highway-env road"
    ):
        environment.step(1)
