"""Drivers in stock scenes of highway-env: what is measured, whose fault collisions are, and the command."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from commands import run
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

from ms_highway.benchmarks.road import SCENES, known_scenes
from ms_highway.benchmarks.road.episodes import Block, check_driver, make_driver, run_episode, summary
from ms_highway.benchmarks.road.measures import Watch, measured

KEYS = {"success", "collisions", "at_fault", "reward_per_step", "max_acceleration", "p50_ms", "p99_ms"}


def watched(action, speed, *others, standing=()):
    """What is seen of an ego on an empty highway, in its middle lane, among cars (x, y, speed) until it crashes."""
    env = gym.make("highway-fast-v0", config={"vehicles_count": 0, "simulation_frequency": 15}).unwrapped
    env.reset(seed=0)
    ego = MDPVehicle(env.road, [100.0, 4.0], 0.0, speed, target_speed=speed, target_speeds=[0, 20, 35])
    env.road.vehicles = [ego, *(Vehicle(env.road, [x, y], 0.0, speed) for x, y, speed in others)]
    env.controlled_vehicles = [ego]
    env.road.objects = [Obstacle(env.road, list(place)) for place in standing]
    env.road.vehicles[-1].crashed = bool(standing)
    watch = Watch(env)
    for each in [action, "IDLE", "IDLE"]:
        env.step(env.action_type.actions_indexes[each])
    assert watch.crashed
    return watch


@pytest.mark.parametrize(
    ("action", "speed", "other", "at_fault"),
    [
        ("IDLE", 20.0, (75.0, 4.0, 35.0), False),  # rear-ended while it keeps its lane
        ("LANE_RIGHT", 20.0, (98.0, 8.0, 20.0), True),  # into a car beside it
        ("LANE_RIGHT", 20.0, (86.0, 8.0, 32.0), True),  # right ahead of a faster car
        ("IDLE", 20.0, (120.0, 4.0, 5.0), True),  # into the car ahead
        ("IDLE", 0.0, (70.0, 4.0, 20.0), True),  # standing on the road
    ],
)
def test_whoever_is_rear_ended_while_keeping_its_lane_is_not_at_fault_and_everybody_else_is(
    action, speed, other, at_fault
):
    assert watched(action, speed, other).at_fault == at_fault


def test_a_crash_far_behind_does_not_excuse_the_ego():
    # the obstacle stops the ego, but does not call itself crashed
    assert watched("IDLE", 35.0, (60.0, 4.0, 0.0), standing=[(131.0, 4.0)]).at_fault


def test_the_acceleration_on_a_circle_is_that_of_turning():
    angle, radius, speed = 0.5 * np.arange(50) / 15, 20.0, 10.0
    states = np.stack([radius * np.sin(angle), -radius * np.cos(angle), angle, np.full(50, speed)], axis=-1)
    motion = measured(states, 1 / 15)
    assert motion["max_acceleration"] == pytest.approx(speed**2 / radius, rel=1e-6)
    assert motion["max_acceleration_of_centre"] == pytest.approx(speed**2 / radius, rel=1e-3)
    assert np.sqrt(motion["squared_jerk"]) == pytest.approx(speed**3 / radius**2, rel=1e-3)


def test_a_crash_in_which_cars_are_pushed_apart_is_no_acceleration():
    motion = watched("IDLE", 20.0, (120.0, 4.0, 5.0)).motion()
    assert motion["max_acceleration"] == 0
    assert motion["max_acceleration_of_centre"] < 1e-6
    assert motion["seconds"] < 2


@pytest.mark.parametrize("scene", ["highway-fast-v0", "merge-v0"])
def test_idm_reaches_goals_without_a_crash_where_doing_nothing_does_not(scene):
    blocks = [Block(scene, driver) for driver in ("idm", "idle")]
    idm, idle = (summary(block, [run_episode(block, seed) for seed in range(2)]) for block in blocks)
    assert idm.keys() >= KEYS
    assert (idm["success"], idm["collisions"]) == (1, 0)
    assert idm["label"] == "unphysical"  # by MOBIL's lane changes
    assert (idle["success"], idle["collisions"], idle["at_fault"]) == (0, 2, 2)
    assert 0 < idm["p50_ms"] <= idm["p99_ms"]


def test_an_episode_that_ends_because_the_ego_leaves_the_road_is_no_success():
    episodes = [run_episode(Block("racetrack-v0", "random"), seed) for seed in range(1000, 1005)]
    assert {(episode.crashed, episode.off_road, episode.success) for episode in episodes} == {(False, True, False)}


def test_a_u_turn_is_a_success_for_who_stays_on_the_road():
    episodes = [run_episode(Block("u-turn-v0", "idle"), seed) for seed in range(1000, 1016)]
    assert {(episode.crashed or episode.off_road, episode.success) for episode in episodes} == {
        (True, False),
        (False, True),
    }


@pytest.mark.parametrize("driver", ["idm", "random"])
def test_the_same_seed_gives_the_same_episode(driver):
    block = Block("merge-v0", driver)
    one, again = (replace(run_episode(block, 3, env), decisions=()) for env in (None, make_driver(block)))
    assert one == again


@pytest.mark.parametrize(
    ("name", "settings"),
    [("priced:1e+3", ("priced:1e+3", False)), ("fixed:tom+intentions", ("fixed:tom", True))],
)
def test_drivers_are_named_with_what_they_know_of_others(name, settings):
    check_driver(name)
    env = make_driver(Block("merge-v0", name))
    assert (env.settings.driver, env.settings.intentions) == settings
    env.reset(seed=0)
    assert env.unwrapped.vehicle.intentions == settings[1]


@pytest.mark.parametrize("name", ["priced+intention", "priced+intentions+intentions"])
def test_an_unknown_suffix_of_a_driver_is_refused(name):
    with pytest.raises(ValueError, match="unknown driver"):
        check_driver(name)


def test_a_scene_without_a_version_is_driven_in_all_of_them_the_newest_first():
    assert known_scenes(["roundabout", "merge-v0", "merge"]) == [
        "roundabout-v1",
        "roundabout-v0",
        "merge-v0",
        "merge-v1",
    ]
    assert {scene for scene in SCENES if "-v1" in scene} >= {"roundabout-v1", "merge-v1", "exit-v1", "u-turn-v1"}


def test_idm_is_paid_for_its_speed_like_an_ego_with_target_speeds():
    env = make_driver(Block("roundabout-v0", "idm"))
    env.reset(seed=0)
    ego = env.unwrapped.vehicle
    ego.speed = 16.0
    assert MDPVehicle.get_speed_index(ego) == 2
    assert MDPVehicle.speed_to_index_default(ego.speed) == 0


@pytest.mark.slow
def test_the_command_writes_figures_episodes_and_films_of_every_driver(tmp_path, capsys):
    file, log = tmp_path / "road.json", tmp_path / "road.csv"
    command = "bench road highway-fast-v0 merge-v0 --drivers idm idle --seeds 2 --seed 5"
    run(f"{command} --json {file} --log {log} --films {tmp_path}")
    results = json.loads(file.read_text())
    drivers = {scene: list(figures) for scene, figures in results.items()}
    assert drivers == {scene: ["idm", "idle"] for scene in ("highway-fast-v0", "merge-v0")}
    assert results["merge-v0"]["idm"].keys() >= KEYS
    assert results["merge-v0"]["idm"]["seeds"] == [5, 2]
    assert len(log.read_text().splitlines()) == 1 + 2 * 2 * 2
    assert "merge-v0, traffic idm: 2 episodes; choices count naive 0, idm 0, tom" in " ".join(
        capsys.readouterr().out.split()
    )
    assert (tmp_path / "merge-v0_idle_failure_5.gif").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("roundabout-v7", "unknown scene 'roundabout-v7'; the scenes are highway-fast-v0"),
        ("merge --drivers budget:1..2", "unknown driver 'budget:1..2'"),
        ("merge --drivers oracle", "unknown driver 'oracle'; the drivers are idm, idle, random, search, human"),
        ("merge --drivers agents/mine.zip", "there is no agent agents/mine.zip; notebooks/examples/train_peers.py"),
        ("merge --drivers switching", "unknown driver 'switching'"),
        ("merge --seeds 0", "--seeds: '0' is no whole number from 1"),
    ],
)
def test_what_is_unknown_is_refused_before_anything_is_driven(arguments, message, refused):
    assert message in refused(f"bench road {arguments} --json road.json")
