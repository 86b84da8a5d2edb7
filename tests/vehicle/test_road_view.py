"""What a driver sees of a road: its lane straightened, arrays of fixed shapes, and driving by it."""

import jax
import numpy as np
import pytest
from highway_env.road.lane import CircularLane, SineLane, StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, Obstacle

from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.vehicle import HumanVehicle
from ms_highway.vehicle.road_view import MAX_LANES, MAX_OBSTACLES, followed_lane, look

AROUND = {  # lanes and what they are like beside their middle
    "straight": lambda side: StraightLane([0, 4 * side], [400, 4 * side], speed_limit=20),
    "slanted": lambda side: StraightLane([-2.4 * side, 3.2 * side], [320 - 2.4 * side, 240 + 3.2 * side]),
    "right-hand bend": lambda side: CircularLane([0, 0], 60 - 4 * side, 0, 3, clockwise=True, speed_limit=10),
    "left-hand bend": lambda side: CircularLane([0, 0], 60 + 4 * side, 0, -3, clockwise=False, speed_limit=10),
    "winding": lambda side: SineLane([0, 4 * side], [400, 4 * side], 3, 0.05, 0, speed_limit=20),
}


def road_with(*lanes, road="ab"):
    network = RoadNetwork()
    for lane in lanes:
        network.add_lane(*road, lane)
    return Road(network, np_random=np.random.RandomState(0))


def put(road, kind, lane, along, lateral, turn=0.0, speed=0.0):
    car = kind(road, lane.position(along, lateral), lane.heading_at(along) + turn, speed)
    (road.vehicles if isinstance(car, Vehicle) else road.objects).append(car)
    return car


@pytest.mark.parametrize("shape", AROUND)
def test_a_view_is_in_the_coordinates_of_the_drivers_lane(shape):
    lanes = [AROUND[shape](side) for side in (0, 1)]
    road = road_with(*lanes)
    lane = lanes[0]
    driver = put(road, HumanVehicle, lane, 30.0, 0.5, 0.02, speed=10.0)
    put(road, Vehicle, lane, 45.0, -0.3, -0.01, speed=9.0)
    put(road, Vehicle, lane, 20.0, 4.0, 0.05, speed=11.0)
    put(road, Vehicle, lane, 12.0, -0.2, 0.0, speed=12.0)
    view = look(driver)
    ahead, behind, _, _, _, behind_right = view.states[1:]
    np.testing.assert_allclose(view.states[0], [0.0, 0.5, 0.02, 10.0], atol=1e-6)
    np.testing.assert_allclose(ahead, [15.0, -0.3, -0.01, 9.0], atol=1e-6)
    np.testing.assert_allclose(behind, [-18.0, -0.2, 0.0, 12.0], atol=1e-6)
    np.testing.assert_allclose(behind_right, [-10.0, 4.0, 0.05, 11.0], atol=1e-6)
    np.testing.assert_allclose(view.scene.lanes, [0.0] + [4.0] * (MAX_LANES - 1), atol=0.02)


def test_whatever_is_on_the_road_a_view_has_the_same_shapes():
    wide, narrow = [AROUND["straight"](side) for side in range(9)], [AROUND["winding"](0)]
    shapes = set()
    for lanes in (wide, narrow):
        for crowd in (0, 1, 30):
            road = road_with(*lanes)
            driver = put(road, HumanVehicle, lanes[-1], 50.0, 0.0)
            for number in range(crowd):
                put(road, Vehicle, lanes[number % len(lanes)], 2.0 + 7 * number, 0.0)
                put(road, Obstacle, lanes[number % len(lanes)], 52.0 + number, 0.0)
            leaves, structure = jax.tree.flatten(look(driver).scene)
            shapes.add((structure, *(np.shape(leaf) for leaf in leaves), look(driver).states.shape))
    assert len(shapes) == 1


def test_of_many_lanes_the_nearest_are_seen():
    lanes = [AROUND["straight"](side) for side in range(9)]
    road = road_with(*lanes)
    driver = put(road, HumanVehicle, lanes[7], 50.0, 0.0)
    np.testing.assert_allclose(look(driver).scene.lanes, [-16, -12, -8, -4, 0, 4])


def test_the_nearest_obstacles_ahead_are_seen_and_landmarks_are_not():
    lane = AROUND["straight"](0)
    road = road_with(lane)
    driver = put(road, HumanVehicle, lane, 50.0, 0.0)
    put(road, Landmark, lane, 60.0, 0.0)
    for along in (120.0, 20.0, 90.0, 70.0):
        put(road, Obstacle, lane, along, 1.0)
    scene = look(driver).scene
    far = [-1000.0, 0.0]
    np.testing.assert_allclose(scene.obstacles, [[20.0, 1.0], [40.0, 1.0]] + [far] * (MAX_OBSTACLES - 2))
    np.testing.assert_allclose(scene.obstacle_size, [2.0, 2.0])


def test_cars_out_of_sight_leave_their_places_empty():
    lane = AROUND["straight"](0)
    road = road_with(lane)
    driver = put(road, HumanVehicle, lane, 50.0, 0.0, speed=20.0)
    put(road, Vehicle, lane, 160.0, 0.0, speed=20.0)
    assert (look(driver).states[1:, 0] == -1000.0).all()


@pytest.mark.parametrize(("along", "lanes"), [(10.0, [-4, 0]), (150.0, [-4, -2]), (185.0, [-4, -4])])
def test_a_lane_that_ends_runs_into_the_nearest_lane_that_goes_on(along, lanes):
    through, ramp = (StraightLane([0, y], [200, y]) for y in (0, 4))
    road = road_with(through, ramp)
    road.network.add_lane("b", "c", StraightLane([200, 0], [400, 0]))
    driver = put(road, HumanVehicle, ramp, along, 0.0)
    np.testing.assert_allclose(sorted(set(look(driver).scene.lanes)), sorted(set(lanes)))


def test_a_lane_where_everything_ends_stays_what_it_is():
    lanes = [StraightLane([0, y], [200, y]) for y in (0, 4)]
    road = road_with(*lanes)
    driver = put(road, HumanVehicle, lanes[1], 185.0, 0.0)
    np.testing.assert_allclose(sorted(set(look(driver).scene.lanes)), [-4, 0])


def test_where_roads_part_a_driver_follows_its_route():
    road = road_with(StraightLane([0, 0], [50, 0]))
    road.network.add_lane("b", "ahead", StraightLane([50, 0], [150, 0]))
    road.network.add_lane("b", "right", CircularLane([50, 30], 30, -np.pi / 2, 0))
    for goal in ("ahead", "right"):
        driver = HumanVehicle(road, [10.0, 0.0])
        driver.plan_route_to(goal)
        driver.position = np.array([53.0, 0.0])
        assert followed_lane(driver, driver.route).index == ("b", goal, 0)


@pytest.mark.parametrize("shape", AROUND)
def test_a_human_follows_a_lane_of_any_shape(shape):
    lane = AROUND[shape](0)
    road = road_with(lane)
    human = put(road, HumanVehicle, lane, 5.0, 0.0, speed=0.9 * lane.speed_limit)
    for _ in range(100):
        road.act()
        road.step(1 / 15)
        assert abs(lane.local_coordinates(human.position)[1]) < 0.5
    assert human.speed == pytest.approx(lane.speed_limit, rel=0.1)
    assert human.last_step.status == "planned"


def test_a_human_goes_no_faster_than_its_target_speed():
    lane = AROUND["straight"](0)
    road = road_with(lane)
    human = put(road, HumanVehicle, lane, 5.0, 0.0, speed=12.0)
    human.target_speed = 12.0
    for _ in range(60):
        road.act()
        road.step(1 / 15)
    assert human.speed == pytest.approx(12.0, abs=0.5)


def test_a_kind_of_human_with_other_weights_drives_otherwise():
    class Lazy(HumanVehicle):
        weights = COMMON_WEIGHTS | {"speed": 0.0}

    lane = AROUND["straight"](0)
    speeds = []
    for kind in (HumanVehicle, Lazy):
        road = road_with(lane)
        human = put(road, kind, lane, 5.0, 0.0, speed=10.0)
        for _ in range(30):
            road.act()
            road.step(1 / 15)
        speeds.append(human.speed)
    assert speeds[0] > speeds[1] + 3.0
