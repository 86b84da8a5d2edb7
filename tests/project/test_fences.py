"""Results that no change of the structure may worsen; ``fences.json`` holds their bounds, which nothing may loosen.

The tests use commands and ``gym.make``, as users do, so that they outlive the structure.
"""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from commands import run

import ms_highway

FENCES = json.loads(Path(__file__).with_name("fences.json").read_text())
SLOW = pytest.mark.slow
STOCK_SCENES = ["merge-v1", *(pytest.param(name, marks=SLOW) for name in ("highway-fast-v0", "roundabout-v0"))]
PAPER_SCENARIOS = ["merger", pytest.param("give_way", marks=SLOW)]


def printed(capsys, command):
    """Return the JSON that a command prints."""
    capsys.readouterr()
    run(f"{command} --json")
    return json.loads(capsys.readouterr().out)


def drive(env, seed):
    """Let a robot drive an episode; return the rewards of its steps and the last ``info``."""
    env.reset(seed=seed)
    rewards, done = [], False
    while not done:
        _, reward, terminated, truncated, info = env.step(0)
        rewards.append(reward)
        done = terminated or truncated
    return rewards, info


def test_the_logs_of_the_released_code_are_replayed(reference, capsys):
    files = printed(capsys, f"validate {reference}")["files"]
    assert len(files) == FENCES["replay"]["files"]
    assert max(errors["reward_error"]["max"] for errors in files.values()) < FENCES["replay"]["reward_error"]
    decisions = [errors["decisions"] for errors in files.values() if "decisions" in errors]
    assert sum(each["agree"] for each in decisions) == FENCES["replay"]["decisions"]
    assert sum(each["all"] for each in decisions) == FENCES["replay"]["decisions"]
    assert max(errors["human_error"]["q99"] for errors in files.values()) < 1e-4
    for name, errors in files.items():
        scenario, _, kind = name.removesuffix(".npz").partition("__")
        error = errors["action_error"]
        if kind == "naive":
            assert error["q99"] < 1e-4, name
        elif kind in ("turn", "tom") and scenario != "stay_back":  # which is chaotic in the reference
            assert error["q50"] < 1e-6, name
            assert error["q90" if kind == "tom" else "q99"] < 1e-4, name


@pytest.fixture(scope="module", params=PAPER_SCENARIOS)
def compared(request, tmp_path_factory):
    """Return a scenario, and the directory with the episodes of its rows in the README's table."""
    out, controllers = tmp_path_factory.mktemp("compare"), " ".join(FENCES["readme"][request.param])
    run(f"compare {request.param} --controllers {controllers} --seeds 30 --out {out}")
    return request.param, out


def test_the_mean_rewards_of_the_readme_are_within_their_intervals(compared):
    scenario, out = compared
    summary = pd.read_csv(out / "summary.csv").set_index("controller")
    for controller, (low, high) in FENCES["readme"][scenario].items():
        assert low <= summary["reward"][controller] <= high, controller
    assert not summary["collision_episodes"].any()


def test_live_and_simulated_episodes_earn_the_same(compared, tmp_path):
    scenario, live = compared
    run(f"sweep {scenario} --controllers tom learned:1 --seeds 5 --out {tmp_path}")
    keys = ["controller", "seed"]
    batch = pd.read_parquet(tmp_path / "episodes").set_index(keys)["reward"]
    alone = pd.read_csv(live / "steps.csv").groupby(keys)["reward"].mean()
    assert len(batch) == 10
    np.testing.assert_allclose(batch, alone[batch.index], atol=FENCES["live_and_batch"])


def test_a_robot_with_a_belief_never_hits_humans_who_never_yield():
    config = {"controller": {"type": "fixed", "model": "tom", "belief": True}, "yielding": "never"}
    env = gym.make("ms-highway/merger-v0", config=config)
    collisions = 0
    for seed in range(FENCES["belief"]["starts"]):
        env.reset(seed=seed)
        collisions += any(env.step(0)[-1]["collision"] for _ in range(40))
    assert collisions == FENCES["belief"]["collisions"]


@pytest.mark.filterwarnings("ignore:.*is out of date")
@pytest.mark.parametrize("scene", STOCK_SCENES)
def test_robots_in_stock_scenes_earn_their_usual_reward_and_crash_no_more_often(scene):
    fence = FENCES["stock"][scene]
    env = ms_highway.drive(gym.make(scene))
    driven = [drive(env, seed) for seed in range(20)]
    rewards = np.array([np.mean(rewards) for rewards, _ in driven])
    assert fence["low"] <= rewards.mean() <= fence["high"]
    assert sum(info["crashed"] for _, info in driven) <= fence["collisions"]


def test_the_recorded_problem_that_ships_is_solved():
    env = ms_highway.drive(gym.make("ms-highway/recorded-v0", config={"ego": "problem"}))
    rewards, info = drive(env, 0)
    assert info["recorded"]["success"]
    assert np.mean(rewards) == pytest.approx(FENCES["recorded"]["reward"], abs=FENCES["recorded"]["tolerance"])


@SLOW
def test_recorded_problems_are_solved_as_often_as_the_results_say(us101_directory, tmp_path):
    file = tmp_path / "road.json"
    run(f"bench road recorded --drivers priced --data {us101_directory} --json {file}")
    driven = json.loads(file.read_text())["recorded"]["priced"]
    assert (driven["episodes"], driven["collisions"]) == (16, 0)
    assert round(16 * driven["success"]) >= FENCES["recorded"]["solved"]


@SLOW
def test_the_shipped_drivers_predict_real_drivers_as_well_as_the_results_say(us101_directory, capsys):
    predictors = printed(capsys, f"irl evaluate --theta us101 --data {us101_directory}")["predictors"]
    for name, errors in FENCES["fde"].items():
        for horizon, error in errors.items():
            assert predictors[name]["fde"][horizon] == pytest.approx(error, rel=FENCES["fde_tolerance"]), name
