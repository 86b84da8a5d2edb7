"""Human drivers as the other vehicles of highway-env's own environments."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle, LinearVehicle
from ms_highway.control.switching import ModelSwitching

from ms_highway.game.scenario import driving_game
from ms_highway.metareasoning.compiled_decision import decide_function
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.compiled_plans import plan_function
from ms_highway.planning.human_models import Naive, ladder
from ms_highway.vehicle import HumanVehicle, RobotVehicle
from ms_highway.vehicle.road_view import look

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

IDLE = 1


def humans_in(name, seed, **config):
    """A stock environment, just reset, among human drivers."""
    config = {"other_vehicles_type": "ms_highway.vehicle.HumanVehicle"} | config
    environment = gym.make(name, config=config).unwrapped
    environment.reset(seed=seed)
    if name == "merge-v0":  # where the ego brakes for nobody, and would be half as fast again as the limit
        environment.vehicle.speed = environment.vehicle.target_speed = 20.0
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

    monkeypatch.setattr("ms_highway.planning.compiled_plans.plan_function", watched)
    return seen


@pytest.mark.slow
def test_humans_drive_ten_episodes_of_stock_environments_with_one_compilation(layouts):
    episodes = [("highway-v0", {"vehicles_count": 10, "duration": 10}, 10), ("merge-v0", {}, 12)]
    plan_function.cache_clear()  # what other tests have compiled, with other settings of JAX, does not count
    driven = 0
    for name, config, steps in episodes:
        for seed in range(5):
            for humans in drive(humans_in(name, seed, **config), steps):
                driven += len(humans)
                for human in humans:
                    assert human.last_step.status == "planned"
                    assert np.isfinite(human.state).all()
                    assert human.on_road
                    assert not human.crashed
    assert driven > 5 * 10 * 10 + 5 * 4 * 8
    (layout,) = layouts
    assert plan_function(Naive(), layout)._cache_size() == 1


@pytest.mark.slow
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


def replaced(environment, kinds):
    """The environment with its first cars replaced by cars of other kinds, its own car being the very first."""
    cars = environment.road.vehicles
    for place, kind in enumerate(kinds):
        car = kind.create_from(cars[place])
        if cars[place] is environment.vehicle:
            environment.vehicle = car
        cars[place] = car
    environment.define_spaces()
    return cars[: len(kinds)]


@pytest.mark.parametrize("kind", [IDMVehicle, LinearVehicle])
def test_highway_envs_drivers_change_lanes_among_humans(kind):
    environment = humans_in("highway-v0", 1, vehicles_count=20, duration=10)
    others = replaced(environment, [type(environment.vehicle)] + [kind] * 10)[1:]
    assert {car.target_speed for car in others} == {30.0}  # the limit, which humans drive at
    environment.vehicle.position[0] -= 1000.0  # out of the way
    changing = set()
    for _ in drive(environment, 4):
        changing |= {car for car in others if car.target_lane_index != car.lane_index}
    assert changing


def test_drivers_of_all_kinds_can_take_each_others_places_and_keep_their_routes():
    environment = humans_in("roundabout-v0", 0)
    routes = [car.route for car in environment.road.vehicles[1:]]
    assert all(len(route) > 1 for route in routes)
    for kind in ("highway_env.vehicle.behavior.IDMVehicle", "ms_highway.vehicle.HumanVehicle"):
        environment = environment.change_vehicles(kind)
        assert [car.route for car in environment.road.vehicles[1:]] == routes
    environment.step(IDLE)


def test_a_human_is_predicted_along_its_route_as_highway_envs_own_drivers_are():
    environment = humans_in("intersection-v0", 0)
    times = np.arange(0.25, 3, 0.25)
    predicted = 0
    for human in (car for car in environment.road.vehicles if isinstance(car, HumanVehicle)):
        driver = IDMVehicle.create_from(human)
        if driver.route[0][:2] == driver.lane_index[:2]:
            for mine, theirs in zip(
                human.predict_trajectory_constant_speed(times),
                driver.predict_trajectory_constant_speed(times),
                strict=True,
            ):
                np.testing.assert_allclose(np.array(mine), np.array(theirs))
            predicted += 1
    assert predicted > 2


def test_humans_keep_to_what_tyres_hold_and_never_reverse_in_a_roundabout():
    slowest, humans = np.inf, []
    for seed in range(2):
        for humans in drive(humans_in("roundabout-v0", seed, policy_frequency=5), 25):
            for human in humans:
                if not human.crashed:
                    curvature, acceleration = human.control
                    total = np.hypot(human.speed**2 * curvature, acceleration - 0.2 * human.speed)
                    assert total < 8.0 * 1.1  # the speed is that after it
                    slowest = min(slowest, human.speed)
    assert humans
    assert slowest >= -1e-9


@pytest.mark.slow
def test_a_robot_by_itself_drives_stock_episodes_and_chooses_its_models_with_one_compilation():
    plan_function.cache_clear()
    decide_function.cache_clear()
    chosen: set[str] = set()
    for name in ("highway-v0", "merge-v0"):
        environment = humans_in(name, 0, vehicles_count=10, duration=8, simulation_frequency=10, policy_frequency=5)
        (robot,) = replaced(environment, [RobotVehicle])
        switching = Switching(np.array([0.09, 0.17]), 0.0, ladder(("naive", "turn")))
        robot.drive_with(ModelSwitching(driving_game(look(robot).scene, 30.0), switching))
        compiling, statuses, models = 0, set(), set()
        for _ in drive(environment, 40):
            compiling += robot.last_step.compile_seconds > 0
            statuses.add(robot.last_step.status)
            models.add(robot.last_step.model)
            assert not robot.crashed
            assert robot.on_road
        assert statuses == {"planned"}
        assert compiling == 0  # after the first of the two acts of a step
        chosen |= models
    assert chosen == {"naive", "turn"}
    assert decide_function.cache_info().currsize == 1
    assert plan_function.cache_info().currsize == 2


@pytest.mark.slow
def test_a_robot_by_itself_with_algorithm_1_refuses_another_rate_than_its_games():
    environment = humans_in("highway-v0", 0, vehicles_count=2)
    (robot,) = replaced(environment, [RobotVehicle])
    switching = Switching(np.array([0.09]), 0.0, ladder(("naive",)))
    robot.drive_with(ModelSwitching(driving_game(look(robot).scene, 30.0), switching))
    with pytest.raises(ValueError, match="configure the environment with 'simulation_frequency': 10"):
        environment.step(IDLE)
