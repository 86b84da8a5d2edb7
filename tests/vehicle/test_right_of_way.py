"""Who goes first where ways meet, and how the others give way."""

from itertools import product

import gymnasium as gym
import pytest

from ms_highway.vehicle import CommuterVehicle
from ms_highway.vehicle.right_of_way import Approach, conflicts

ENTRANCE = ("ses", "se", 0)
RING = ("we", "sx", 1)


def roundabout(*cars, route="nxs"):
    """An empty roundabout with commuters, each given by lane, position along it and
    speed.
    """
    environment = gym.make("roundabout-v1").unwrapped
    environment.reset(seed=0)
    road = environment.road
    road.vehicles = []
    for lane, along, speed in cars:
        car = CommuterVehicle.make_on_lane(road, lane, along, speed)
        car.target_speed = 12.0
        car.plan_route_to(route)
        road.vehicles.append(car)
    return road, *road.vehicles


def test_exactly_one_of_two_vehicles_goes_first():
    _, one, other = roundabout((ENTRANCE, 0.0, 8.0), (RING, 0.0, 12.0))
    distances = (0.0, 3.0, 30.0)
    ranks = ((0.0, True), (0.0, False), (1.0, True))
    speeds = (0.0, 12.0)
    kinds = list(product(distances, ranks, speeds))
    for own_kind, other_kind in product(kinds, kinds):
        own_distance, own_rank, one.speed = own_kind
        other_distance, other_rank, other.speed = other_kind
        approach = Approach(one, own_distance, 5.0, own_rank, 0)
        others = Approach(other, other_distance, 5.0, other_rank, 1)
        assert approach.goes_before(others) != others.goes_before(approach)


def test_who_enters_a_roundabout_gives_way_and_enters_afterwards():
    road, entering, circulating = roundabout((ENTRANCE, 0.0, 8.0), (RING, 5.0, 12.0))
    ((own, other),) = conflicts(entering)
    assert other.goes_before(own)
    slowest = circulating.speed
    for _ in range(15 * 9):
        road.act()
        road.step(1 / 15)
        slowest = min(slowest, circulating.speed)
        assert not entering.crashed
    assert slowest > 10.0
    assert entering.lane_index[:2] not in (ENTRANCE[:2], ("ser", "ses"))


@pytest.mark.parametrize("speed", [8.0, 12.0])
def test_who_is_alone_gives_way_to_nobody(speed):
    _, entering = roundabout((ENTRANCE, 0.0, speed))
    assert conflicts(entering) == []
