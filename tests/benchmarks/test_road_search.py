"""The search that bounds what drivers of stock scenes can earn, and how far they stay behind it."""

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from commands import run
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.benchmarks.road import SEARCH
from ms_highway.benchmarks.road.bound import behind, bound_of, read_bounds
from ms_highway.benchmarks.road.episodes import Block, run_episode
from ms_highway.benchmarks.road.search import Choice, best_end, copied, put_told

SHORT = {"duration": 4, "vehicles_count": 8}


def told_in(scene, config=None, seed=3):
    env = gym.make(scene, config=config, disable_env_checker=True)
    env.reset(seed=seed)
    put_told(env)
    return env.unwrapped


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
def test_a_copy_of_an_environment_has_the_same_future_and_leaves_the_environment_alone():
    env = told_in("intersection-v0")
    places, ends = [car.position.copy() for car in env.road.vehicles], []
    for one in (copied(env), copied(env)):
        one.vehicle.tell(Choice(0.5), 10.0)
        for _ in range(4):
            one.step(1)  # cars join by chance
        ends.append(np.array([car.position for car in one.road.vehicles]))
    np.testing.assert_array_equal(*ends)
    assert all((car.position == place).all() for car, place in zip(env.road.vehicles, places, strict=True))


def test_the_search_passes_a_slow_car_that_it_would_hit_at_its_speed():
    env = told_in("highway-fast-v0", SHORT, seed=0)
    slow = Vehicle(env.road, env.vehicle.position + np.array([30.0, 0.0]), 0.0, 15.0)
    env.road.vehicles = [env.vehicle, slow]
    found, kept = best_end(env, 30.0).told, copied(env)
    for choice in found:
        env.vehicle.tell(choice, 30.0)
        env.step(1)
    assert not env.vehicle.crashed
    assert env.vehicle.speed > 28.0
    assert env.vehicle.position[0] > env.road.vehicles[1].position[0]
    for _ in found:
        kept.vehicle.tell(Choice(1.0), 30.0)
        kept.step(1)
    assert kept.vehicle.crashed


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize(("scene", "desired", "seed"), [("roundabout-v0", 16.0, 1), ("intersection-v0", 10.0, 2)])
@pytest.mark.slow
def test_what_the_search_found_is_what_the_environment_does(scene, desired, seed):
    env = told_in(scene, seed=seed)
    found, earned = best_end(env, desired, kept=2), 0.0
    for choice in found.told:
        env.vehicle.tell(choice, desired)
        earned += env.step(1)[1]
    assert earned == found.earned
    assert env.vehicle.position.tolist() == found.ego.position.tolist()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
def test_the_search_arrives_within_tyres_where_doing_nothing_crashes():
    seed = 3
    idle, search = (run_episode(Block("intersection-v0", driver), seed) for driver in ("idle", "search"))
    assert idle.crashed
    assert search.success
    assert search.max_acceleration < 5.0
    assert search.reward / search.steps > 0.5


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log of two episodes of doing nothing, as if the search had driven them, which takes a minute."""
    file = tmp_path_factory.mktemp("bound") / "log.csv"
    run(f"bench road highway-fast-v0 --drivers idle --seeds 2 --log {file}")
    file.write_text(file.read_text().replace(",idle,", f",{SEARCH},"))
    return file


def test_drivers_are_compared_with_the_search_in_a_log(log, capsys, tmp_path):
    found, table = read_bounds(log, "idm")["highway-fast-v0"], pd.read_csv(log)
    assert [one.reward for one in found.values()] == table["reward"].tolist()
    capsys.readouterr()
    run(f"bench road highway-fast-v0 --drivers idle --seeds 3 --bound {log} --json {tmp_path / 'road.json'}")
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("regret", "success"))
    figures = json.loads((tmp_path / "road.json").read_text())["highway-fast-v0"]["idle"]
    assert (figures["bounded"], figures["regret"]) == (2, 0.0)


def test_regret_and_waiting_are_of_the_starts_that_both_have():
    episodes = [run_episode(Block("highway-fast-v0", "idle"), seed) for seed in range(2)]
    worse = [replace(one, reward=one.reward - one.steps, stood=one.stood + 2.0, success=True) for one in episodes]
    found = bound_of([replace(episodes[0], success=True)])
    told = {"bounded": 1, "solvable": 1.0, "solved": 1.0, "regret": 1.0, "waited": 2.0}
    assert behind(worse, found) == pytest.approx(told)
    crashed = [replace(one, success=False) for one in worse]
    assert behind(crashed, found) == told | {"solved": 0.0, "waited": None}
    assert behind(worse, bound_of(episodes))["solved"] is None
    assert behind(worse, {}) == {}


COLUMNS = "scene,driver,traffic,seed,success,reward,steps,stood\n"


@pytest.mark.parametrize(
    "content",
    [
        *("", "a,b\n1,2\n", COLUMNS),
        *(COLUMNS + f"merge-v0,search,idm,{rest}\n" for rest in ("0,True,1.0,0,0.0", "0,,1.0,2,0.0", "0,True,,2,0.0")),
        COLUMNS + 2 * "merge-v0,search,idm,0,True,1.0,2,0.0\n",
    ],
)
def test_a_file_that_is_no_log_of_a_search_is_refused_with_the_remedy(content, tmp_path, refused):
    file = tmp_path / "bound.csv"
    file.write_text(content)
    message = refused(f"bench road merge-v0 --drivers idle --bound {file} --json {tmp_path / 'road.json'}")
    assert str(file) in message
    assert "--drivers search --log" in message
    assert not (tmp_path / "road.json").exists()


def test_a_search_of_other_starts_or_one_that_would_be_overwritten_or_takes_hours_is_refused(log, refused):
    assert "has no start of these scenes and seeds" in refused(f"bench road merge-v0 --drivers idle --bound {log}")
    again = f"bench road highway-fast-v0 --drivers idle --bound {log} --log {log}"
    assert "would overwrite" in refused(again)
    assert "racetrack-v1 lasts 300 s, too long" in refused("bench road racetrack-v1 --drivers search --seeds 1")
