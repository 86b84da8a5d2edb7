"""highway-env vehicles with the paper's motion, and cars that plan."""

from math import atan

import numpy as np
import pytest
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.utils import are_polygons_intersecting
from highway_env.vehicle.objects import Landmark
from ms_highway.control.fixed import FixedModel
from ms_highway.control.switching import ModelSwitching

from ms_highway.envs.stage import Cone
from ms_highway.game.dynamics import step
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.game.reward import linear_reward
from ms_highway.game.scenario import driving_game
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.human_models import MODELS, ladder
from ms_highway.vehicle import BicycleVehicle, CommuterVehicle, HumanVehicle, RobotVehicle, ScriptedVehicle
from ms_highway.vehicle.road_view import look


def straight_road(lanes=2):
    return Road(RoadNetwork.straight_road_network(lanes, speed_limit=20.0), np_random=np.random.RandomState(0))


def test_a_step_of_the_bicycle_vehicle_is_the_cores_step():
    car = BicycleVehicle(straight_road(), [0.0, 0.0], heading=0.1, speed=18.0)
    before = car.state
    car.act({"steering": 0.05, "acceleration": 2.0})
    omega = np.tan(0.05) / 5.0
    car.step(0.1)
    np.testing.assert_allclose(car.state, step(car.dynamics, before, np.array([omega, 2.0])), atol=1e-12)
    assert car.state.dtype == np.float64


def test_a_control_and_its_steering_angle_mean_the_same():
    car = BicycleVehicle(straight_road(), [0.0, 0.0], speed=18.0)
    car.execute(np.array([0.02, -1.0]))
    assert car.action == {"steering": atan(0.02 * 5.0), "acceleration": -1.0}
    other = BicycleVehicle(straight_road(), [0.0, 0.0], speed=18.0)
    other.act(car.action)
    np.testing.assert_allclose(other.control, car.control, atol=1e-12)


def test_a_scripted_car_keeps_its_velocity_against_friction():
    car = ScriptedVehicle(straight_road(), [0.0, 0.0], speed=20.0)
    for _ in range(30):
        car.act({"steering": 0.3, "acceleration": -5.0})
        car.step(0.1)
    assert car.speed == pytest.approx(20.0)
    np.testing.assert_allclose(car.position, [60.0, 0.0])


def test_a_crashed_bicycle_brakes_to_a_stop_as_highway_env_has_it():
    road = straight_road()
    cars = [BicycleVehicle(road, [x, 0.0], speed=speed) for x, speed in ((0.0, 20.0), (8.0, 0.0))]
    road.vehicles = cars
    for _ in range(30):
        road.step(0.1)
    assert cars[0].crashed
    assert cars[0].speed < 1.0
    assert cars[1].position[0] > 8.0  # solid bodies push each other


@pytest.mark.parametrize("kind", [Cone, BicycleVehicle, Landmark])
def test_a_car_that_is_not_solid_is_hit_where_highway_env_sees_the_bodies_overlap(kind):
    road, random, hits = straight_road(), np.random.default_rng(0), []
    for _ in range(300):
        car = BicycleVehicle(road, random.uniform(-1, 1, 2), random.uniform(-4, 4), speed=20.0)
        other = kind(road, random.uniform(-5, 5, 2), random.uniform(-4, 4))
        car.solid = False
        other.solid = kind is Cone
        still = np.zeros(2)
        overlap, *_ = are_polygons_intersecting(car.polygon(), other.polygon(), still, still)
        car.handle_collisions(other, 0.1)
        assert (car.hit, other.hit) == (overlap, overlap and not other.solid)
        assert (car.crashed, other.crashed, car.impact) == (False, False, None)
        hits.append(overlap)
    assert 0.2 < np.mean(hits) < 0.8


@pytest.mark.parametrize(("width_apart", "hit"), [(2.49, True), (2.51, False)])
def test_bodies_side_by_side_are_told_apart_to_the_centimetre(width_apart, hit):
    road = straight_road()
    cars = [BicycleVehicle(road, [0.0, y], heading=np.pi, speed=20.0) for y in (0.0, width_apart)]
    for car in cars:
        car.solid = False
    road.vehicles = cars
    road.step(0.1)
    assert [car.hit for car in cars] == [hit, hit]


def test_a_human_in_a_foreign_scene_finds_its_lane_and_its_speed_past_a_cone():
    road = straight_road()
    road.objects.append(Cone(road, [40.0, 4.0]))
    human = HumanVehicle(road, [0.0, 1.0], speed=16.0)
    road.vehicles = [human, ScriptedVehicle(road, [-60.0, 4.0], speed=20.0)]
    for _ in range(40):
        road.act()
        road.step(0.1)
    assert human.position[0] > 60.0
    assert abs(human.position[1]) < 0.5
    assert human.speed == pytest.approx(20.0, abs=1.5)
    assert not human.crashed
    assert human.last_step.status == "planned"


@pytest.mark.slow
def test_a_human_that_plans_a_second_ahead_brakes_in_time_for_a_slower_car():
    class FarsightedHuman(HumanVehicle):
        planning = PlanningSettings(horizon=10)

    road = straight_road()
    human = FarsightedHuman(road, [0.0, 4.0], speed=20.0)
    leader = ScriptedVehicle(road, [60.0, 4.0], speed=12.0)
    road.vehicles = [human, leader]
    for _ in range(100):
        road.act()
        road.step(0.1)
    assert len(human.last_step.plan) == 10
    assert not human.crashed
    assert human.speed == pytest.approx(12.0, abs=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("leader_speed", "gaps"),  # between bumpers; at speed, the quartiles of drivers on US-101
    [(0.0, (2, 6)), (10.0, (10.6, 22.4)), (20.0, (16.9, 34.8))],
)
def test_a_commuter_follows_at_the_distances_of_real_drivers_and_stops_behind_a_standing_car(leader_speed, gaps):
    road = straight_road(lanes=1)
    commuter = CommuterVehicle(road, [0.0, 0.0], speed=20.0)
    leader = ScriptedVehicle(road, [35.0, 0.0], speed=leader_speed)
    road.vehicles = [commuter, leader]
    for _ in range(250):
        road.act()
        road.step(0.1)
    assert not commuter.crashed
    assert commuter.last_step.status == "planned"
    assert commuter.speed == pytest.approx(leader_speed, abs=1.0)
    assert gaps[0] < leader.position[0] - commuter.position[0] - commuter.LENGTH < gaps[1]


def test_commuters_differ_by_the_roads_random_numbers():
    one, same = (
        [CommuterVehicle(road, [20.0 * number, 0.0], speed=20.0).traits for number in range(3)]
        for road in (straight_road(), straight_road())
    )
    assert one == same
    assert len({traits.headway for traits in one}) == 3
    assert all(0.3 < traits.headway < 4 and 0.6 < traits.desired_speed < 1.6 for traits in one)


def test_a_commuter_plans_for_its_own_headway_patience_and_desired_speed():
    road = straight_road()
    commuter = CommuterVehicle(road, [0.0, 0.0], speed=20.0)
    road.vehicles = [commuter]
    road.act()
    robot = commuter.controller.game.robot
    assert float(robot.headway) == pytest.approx(commuter.traits.headway)
    assert float(robot.speed_limit) == pytest.approx(20.0 * commuter.traits.desired_speed)
    typical = linear_reward(commuter.weights, 1.0).comfort[1]
    assert float(robot.comfort[1]) == pytest.approx(typical * commuter.traits.patience, rel=1e-5)


@pytest.mark.slow
def test_a_robot_drives_in_a_foreign_scene_with_its_own_game():
    road = straight_road()
    robot = RobotVehicle(road, [0.0, 0.0], speed=18.0)
    human = HumanVehicle(road, [-3.0, 4.0], speed=18.0)
    road.vehicles = [robot, human]
    game = driving_game(look(robot).scene, speed_limit=20.0)
    switching = Switching(np.array([0.09, 0.17]), 0.1, ladder(("naive", "turn")))
    robot.drive_with(ModelSwitching(game, switching), [human])
    for _ in range(20):
        road.act()
        road.step(0.1)
    assert robot.last_step.status == "planned"
    assert robot.speed > 18.5
    assert not robot.crashed


def test_a_robot_told_no_companions_takes_the_nearest_in_time_for_its_partner_and_keeps_to_it():
    road = straight_road()
    robot = RobotVehicle(road, [0.0, 4.0], speed=18.0)
    ahead, beside = (
        ScriptedVehicle(road, [x, y], speed=speed) for x, y, speed in ((30.0, 4.0, 20.0), (-8.0, 0.0, 20.0))
    )
    road.vehicles = [robot, ahead, beside]
    controller = FixedModel(driving_game(look(robot).scene, speed_limit=20.0), MODELS["naive"])
    robot.drive_with(controller)
    partners = []
    for x in (-8.0, 14.0, 17.0, 40.0):  # of the car beside it: the other is 1.4 s ahead
        beside.position[0] = x
        robot.act()
        partners.append(robot.partner)
    assert partners == [beside, beside, beside, ahead]
    np.testing.assert_allclose(robot.last_state[1], look(robot).states[1])
    road.vehicles.remove(ahead)
    robot.act()
    assert robot.partner is beside
    road.vehicles.remove(beside)
    robot.act()
    assert robot.partner is None
    assert robot.last_step.status == "planned"


def test_a_car_that_is_told_to_stop_brakes_within_its_grip_and_stands():
    road = straight_road()
    human = HumanVehicle(road, [0.0, 0.0], speed=15.0)
    road.vehicles = [human]
    human.target_speed = 0
    speeds = [human.speed]
    for _ in range(45):
        road.act()
        road.step(1 / 15)
        speeds.append(human.speed)
    assert abs(np.diff(speeds)).max() <= 8.0 / 15 + 1e-9
    assert min(speeds) >= -1e-9
    assert speeds[-1] == pytest.approx(0.0, abs=1e-6)
    human.target_speed = None
    for _ in range(15):
        road.act()
        road.step(1 / 15)
    assert human.speed > 2.0


def test_a_car_that_plans_takes_no_action_by_name_but_idle():
    road = straight_road()
    human = HumanVehicle(road, [0.0, 0.0], speed=15.0)
    human.act("IDLE")
    assert human.last_step is None
    with pytest.raises(ValueError, match=r"'FASTER'.*'IDLE'"):
        human.act("FASTER")


def test_vehicle_at_a_stock_lane_is_created_like_any_other():
    road = straight_road()
    lane: StraightLane = road.network.lanes_list()[0]
    car = HumanVehicle.make_on_lane(road, ("0", "1", 0), 30.0, speed=15.0)
    np.testing.assert_allclose(car.position, lane.position(30.0, 0))
    assert HumanVehicle.create_from(car).speed == 15.0
