"""Drivers in stock scenes of highway-env: what is measured, whose fault collisions are, and the command."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle
from ms_highway.benchmarks.road.summary import summary

from ms_highway.benchmarks.road.episodes import TRAFFIC, Block, make_driver, run_episode
from ms_highway.benchmarks.road.measures import Watch, measured
from ms_highway.benchmarks.road.names import check_drivers
from ms_highway.benchmarks.road.peers import Idm
from ms_highway.cli.bench_road import TRAFFIC_NAMES
from ms_highway.cli.main import build_parser, main

KEYS = {"success", "collisions", "at_fault", "reward_per_step", "max_acceleration", "p50_ms", "p99_ms"}
EAST = 0.0  # rad


@pytest.fixture
def road():
    """highway-fast-v0 with nothing on it but an ego in the middle lane at 20 m/s."""
    env = gym.make("highway-fast-v0", config={"vehicles_count": 0, "simulation_frequency": 15}).unwrapped
    env.reset(seed=0)
    ego = MDPVehicle(env.road, [100.0, 4.0], EAST, 20.0)
    env.road.vehicles, env.controlled_vehicles = [ego], [ego]
    return env


def add(env, x, y, speed):
    """Add a car that goes straight on, whatever happens."""
    env.road.vehicles.append(Vehicle(env.road, [x, y], EAST, speed))


def watched(env, actions):
    """Drive until the ego crashes."""
    watch = Watch(env)
    for action in actions:
        env.step(env.action_type.actions_indexes[action])
    assert watch.crashed
    return watch


def test_a_rear_end_collision_of_an_ego_that_keeps_its_lane_is_not_its_fault(road):
    add(road, 75.0, 4.0, 35.0)
    assert not watched(road, ["IDLE"] * 3).at_fault


def test_a_lane_change_into_a_car_is_the_egos_fault(road):
    add(road, 98.0, 8.0, 20.0)
    assert watched(road, ["LANE_RIGHT"] * 3).at_fault


def test_a_cut_in_right_ahead_of_a_faster_car_is_the_egos_fault(road):
    add(road, 86.0, 8.0, 32.0)
    watch = watched(road, ["LANE_RIGHT", "IDLE", "IDLE"])
    assert watch.at_fault


def test_driving_into_the_car_ahead_is_the_egos_fault(road):
    add(road, 120.0, 4.0, 5.0)
    assert watched(road, ["IDLE"] * 3).at_fault


def test_a_car_that_stands_on_the_road_and_is_hit_is_at_fault(road):
    road.vehicle.speed = road.vehicle.target_speed = 0.0
    road.vehicle.target_speeds = np.zeros(3)
    add(road, 70.0, 4.0, 20.0)
    assert watched(road, ["IDLE"] * 3).at_fault


def test_a_crash_far_behind_does_not_excuse_the_ego(road):
    road.vehicle.speed = road.vehicle.target_speed = 35.0
    road.road.objects.append(Obstacle(road.road, [131.0, 4.0]))  # which stops the ego, but does not call itself crashed
    add(road, 60.0, 4.0, 0.0)
    road.road.vehicles[-1].crashed = True
    assert watched(road, ["IDLE"] * 3).at_fault


def test_the_acceleration_on_a_circle_is_that_of_turning():
    angle, radius, speed = 0.5 * np.arange(50) / 15, 20.0, 10.0
    states = np.stack([radius * np.sin(angle), -radius * np.cos(angle), angle, np.full(50, speed)], axis=-1)
    motion = measured(states, 1 / 15)
    assert motion.max_acceleration == pytest.approx(speed**2 / radius, rel=1e-6)
    assert motion.max_acceleration_of_centre == pytest.approx(speed**2 / radius, rel=1e-3)
    assert np.sqrt(motion.squared_jerk) == pytest.approx(speed**3 / radius**2, rel=1e-3)


def test_a_crash_in_which_cars_are_pushed_apart_is_no_acceleration(road):
    add(road, 120.0, 4.0, 5.0)
    motion = watched(road, ["IDLE"] * 5).motion()
    assert motion.max_acceleration == 0
    assert motion.max_acceleration_of_centre < 1e-6
    assert motion.seconds < 2


@pytest.mark.parametrize("scene", ["highway-fast-v0", "merge-v0"])
def test_idm_reaches_goals_without_a_crash_where_doing_nothing_does_not(scene):
    results = {}
    for driver in ("idm", "idle"):
        block = Block(scene, driver)
        results[driver] = summary(block, [run_episode(block, seed) for seed in range(2)])
    assert results["idm"].keys() >= KEYS
    assert results["idm"]["success"] == 1
    assert results["idm"]["collisions"] == 0
    assert results["idm"]["label"] == "unphysical"  # by MOBIL's lane changes
    assert results["idle"]["success"] == 0
    assert results["idle"]["collisions"] == results["idle"]["at_fault"] == 2
    assert 0 < results["idm"]["p50_ms"] <= results["idm"]["p99_ms"]


def test_an_episode_that_ends_because_the_ego_leaves_the_road_is_no_success():
    episodes = [run_episode(Block("racetrack-v0", "random"), seed) for seed in range(1000, 1005)]
    assert not any(episode.crashed for episode in episodes)
    assert all(episode.off_road and not episode.success for episode in episodes)


@pytest.mark.parametrize("driver", ["idm", "random"])
def test_the_same_seed_gives_the_same_episode(driver):
    block = Block("merge-v0", driver)
    one, again = (replace(run_episode(block, 3, env), decisions=()) for env in (None, make_driver(block)))
    assert one == again


@pytest.mark.parametrize(
    ("name", "driver", "traits", "belief"),
    [
        ("switching:1e+3", "switching:1e+3", False, False),
        ("switching:1e+3+traits+belief", "switching:1e+3", True, True),
        ("fixed:tom+belief", "fixed:tom", False, True),
    ],
)
def test_drivers_are_named_with_what_they_know_of_others(name, driver, traits, belief):
    check_drivers([name], ["merge-v0"])
    settings = make_driver(Block("merge-v0", name)).settings
    assert (settings.driver, settings.traits, settings.belief) == (driver, traits, belief)


def test_idm_is_paid_for_its_speed_like_an_ego_with_target_speeds():
    env = make_driver(Block("roundabout-v0", "idm"))
    assert isinstance(env, Idm)
    env.reset(seed=0)
    ego = env.unwrapped.vehicle
    ego.speed = 16.0
    assert MDPVehicle.get_speed_index(ego) == 2
    assert MDPVehicle.speed_to_index_default(ego.speed) == 0


@pytest.mark.slow
def test_the_command_writes_figures_and_episodes_of_every_driver(tmp_path, capsys):
    file, log = tmp_path / "road.json", tmp_path / "road.csv"
    scenes = ["highway-fast", "merge-v0"]
    arguments = ["bench", "road", *scenes, "--drivers", "idm", "idle", "--seeds", "2", "--seed", "5"]
    assert main([*arguments, "--json", str(file), "--log", str(log)]) == 0
    results = json.loads(file.read_text())
    assert list(results) == ["highway-fast-v0", "merge-v0"]
    for drivers in results.values():
        assert list(drivers) == ["idm", "idle"]
        for figures in drivers.values():
            assert figures.keys() >= KEYS
            assert figures["seeds"] == [5, 2]
    assert len(log.read_text().splitlines()) == 1 + 2 * 2 * 2
    assert "merge-v0: 2 episodes" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["roundabout-v7"], "unknown scene 'roundabout-v7'; the scenes are highway-fast-v0"),
        (["merge", "--drivers", "budget:1..2"], "unknown driver 'budget:1..2'"),
        (["merge", "--drivers", "oracle"], "unknown driver 'oracle'; the drivers are switching"),
        (["merge", "--drivers", "fixed:oracle"], "unknown driver 'fixed:oracle'"),
        (["racetrack", "--drivers", "dqn"], "dqn needs discrete actions; leave out racetrack-v0"),
        (["merge", "--seeds", "0"], "--seeds is 0; it must be 1 or more"),
    ],
)
def test_what_is_unknown_is_refused_before_anything_is_driven(arguments, message, tmp_path, capsys):
    file = tmp_path / "road.json"
    assert main(["bench", "road", *arguments, "--json", str(file)]) == 2
    assert message in capsys.readouterr().err
    assert not file.exists()


def test_scenarios_are_measured_as_before_beside_the_road():
    options = build_parser().parse_args(["bench", "merger", "stay_back", "--peer", "casadi"])
    assert options.scenarios == ["merger", "stay_back"]
    assert not hasattr(options, "scenes")
    assert build_parser().parse_args(["bench", "road", "merge", "--seeds", "3"]).scenes == ["merge"]


def test_the_kinds_of_traffic_in_the_help_text_are_those_that_are_known():
    assert tuple(TRAFFIC) == TRAFFIC_NAMES
