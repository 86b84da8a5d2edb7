"""The search that bounds what drivers of stock scenes can earn, and how far they stay behind it."""

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
from ms_highway.benchmarks.road.search import Choice, Told, best_choices, copied
from ms_highway.envs.road.stock import replace_ego

SHORT = {"duration": 4, "vehicles_count": 8}


def told_in(scene, config=None, seed=3):
    env = gym.make(scene, config=config, disable_env_checker=True)
    env.reset(seed=seed)
    told = replace_ego(env, lambda old: Told(old.road, old.position, old.heading, old.speed))
    told.target_lane_index = told.lane_index
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
    found, kept = best_choices(env, 30.0), copied(env)
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
    earned = [found.earned for found in read_bounds(log, "idm")["highway-fast-v0"].values()]
    table = pd.read_csv(log)
    assert earned == pytest.approx((table["reward"] / table["steps"]).tolist())
    capsys.readouterr()
    run(f"bench road highway-fast-v0 --drivers idle --seeds 2 --bound {log} --json {tmp_path / 'road.json'}")
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("solved", "regret", "waited", "0.000"))
    assert '"regret": 0.0' in (tmp_path / "road.json").read_text()


def test_regret_and_waiting_are_of_the_starts_that_both_have():
    episodes = [run_episode(Block("highway-fast-v0", "idle"), seed) for seed in range(2)]
    worse = [replace(one, reward=one.reward - one.steps, stood=one.stood + 2.0, success=False) for one in episodes]
    better = bound_of([replace(episodes[0], success=True)])
    assert behind(worse, better) == pytest.approx(
        {"bounded": 1, "solvable": 1.0, "solved": 0.0, "regret": 1.0, "waited": 2.0}
    )
    assert behind(worse, {}) == {}


@pytest.mark.parametrize("content", ["", "a,b\n1,2\n", "scene,driver,seed,success,reward,steps,stood,traffic\n"])
def test_a_file_that_is_no_log_of_a_search_is_refused_with_the_remedy(content, tmp_path, refused):
    file = tmp_path / "bound.csv"
    file.write_text(content)
    message = refused(f"bench road merge-v0 --drivers idle --bound {file} --json {tmp_path / 'road.json'}")
    assert str(file) in message
    assert "--drivers search --log" in message
    assert not (tmp_path / "road.json").exists()
