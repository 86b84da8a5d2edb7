"""Results that no change of the structure may worsen; ``fences.json`` holds their
bounds, which nothing may loosen.

The tests use commands and ``gym.make``, as users do, so that they outlive the
structure.
"""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from commands import run
from episodes import drives_long

import ms_highway

FENCES = json.loads(Path(__file__).with_name("fences.json").read_text())


def printed(capsys, command):
    """Return the JSON that a command prints."""
    capsys.readouterr()
    run(f"{command} --json")
    return json.loads(capsys.readouterr().out)


def drive(env, seed):
    """Let a robot drive an episode; return the mean reward of its steps and the last
    ``info``.
    """
    env.reset(seed=seed)
    rewards = []
    done = False
    while not done:
        _, reward, terminated, truncated, info = env.step(0)
        rewards.append(reward)
        done = terminated or truncated
    return np.mean(rewards), info


def test_the_logs_of_the_released_code_are_replayed(reference, capsys):
    fence = FENCES["replay"]
    files = printed(capsys, f"validate {reference}")["files"]
    assert len(files) == fence["files"]
    decisions = [
        errors["decisions"] for errors in files.values() if "decisions" in errors
    ]
    for counted in ("agree", "all"):
        assert sum(each[counted] for each in decisions) == fence["decisions"]
    for name, errors in files.items():
        scenario, _, kind = name.removesuffix(".npz").partition("__")
        error = errors["action_error"]
        assert errors["reward_error"]["max"] < fence["reward_error"], name
        assert errors["human_error"]["q99"] < 1e-4, name
        if kind == "naive":
            assert error["q99"] < 1e-4, name
        elif (
            kind in ("turn", "tom") and scenario != "stay_back"
        ):  # which is chaotic in the reference
            assert error["q50"] < 1e-6, name
            assert error["q90" if kind == "tom" else "q99"] < 1e-4, name


@pytest.fixture(scope="module", params=FENCES["readme"])
def compared(request, tmp_path_factory, optimized):
    """Return a scenario, and the directory with the episodes of its rows in the
    README's table.
    """
    scenario = request.param
    out = tmp_path_factory.mktemp("compare")
    run(
        f"compare {scenario} --controllers {' '.join(FENCES['readme'][scenario])}"
        f" --seeds 30 --out {out}"
    )
    return scenario, out


@pytest.mark.slow
def test_the_mean_rewards_of_the_readme_are_within_their_intervals(compared):
    scenario, out = compared
    summary = pd.read_csv(out / "summary.csv").set_index("controller")
    for controller, (low, high) in FENCES["readme"][scenario].items():
        assert low <= summary["reward"][controller] <= high, controller
    assert not summary["collision_episodes"].any()


@pytest.mark.slow
def test_live_and_simulated_episodes_earn_the_same(compared, tmp_path):
    scenario, live = compared
    run(f"sweep {scenario} --controllers tom learned:1 --seeds 5 --out {tmp_path}")
    keys = ["controller", "seed"]
    batch = pd.read_parquet(tmp_path / "episodes").set_index(keys)["reward"]
    alone = pd.read_csv(live / "steps.csv").groupby(keys)["reward"].mean()
    assert len(batch) == 10
    np.testing.assert_allclose(batch, alone[batch.index], atol=FENCES["live_and_batch"])


def test_a_robot_with_a_belief_never_hits_unyielding_humans():
    env = gym.make(
        "ms-highway/merger-v0", config={"controller": "tom+belief", "yielding": "never"}
    )
    collisions = 0
    fence = FENCES["belief"]
    for seed in range(fence["starts"]):
        env.reset(seed=seed)
        collisions += any(env.step(0)[-1]["collision"] for _ in range(40))
    assert collisions == fence["collisions"]


@drives_long
@pytest.mark.filterwarnings("ignore:.*is out of date")
@pytest.mark.parametrize("scene", FENCES["stock"])
def test_robots_in_stock_scenes_earn_and_crash_as_usual(scene):
    fence = FENCES["stock"][scene]
    env = ms_highway.drive(gym.make(scene))
    rewards, infos = zip(*(drive(env, seed) for seed in range(20)), strict=True)
    assert fence["low"] <= np.mean(rewards) <= fence["high"]
    assert sum(info["crashed"] for info in infos) <= fence["collisions"]


def test_the_recorded_problem_that_ships_is_solved():
    env = gym.make("ms-highway/recorded-v0", config={"ego": "problem"})
    fence = FENCES["recorded"]
    reward, info = drive(ms_highway.drive(env), 0)
    assert info["recorded"]["success"]
    assert reward == pytest.approx(fence["reward"], abs=fence["tolerance"])


@drives_long
def test_recorded_problems_are_solved_as_often_as_the_results_say(
    us101_directory, tmp_path
):
    file = tmp_path / "road.json"
    run(f"bench road recorded --drivers priced --data {us101_directory} --json {file}")
    driven = json.loads(file.read_text())["recorded"]["priced"]
    assert (driven["episodes"], driven["collisions"]) == (16, 0)
    assert round(16 * driven["success"]) >= FENCES["recorded"]["solved"]


@pytest.mark.slow
def test_shipped_drivers_predict_real_ones_as_the_results_say(us101_directory, capsys):
    predictors = printed(
        capsys, f"irl evaluate --theta us101 --data {us101_directory}"
    )["predictors"]
    for name, errors in FENCES["fde"].items():
        for horizon, error in errors.items():
            assert predictors[name]["fde"][horizon] == pytest.approx(
                error, rel=FENCES["fde_tolerance"]
            ), name
