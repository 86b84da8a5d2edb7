"""Features of one's own: in plans, decisions, environments, batches and commands, without a change of the package."""

import pickle
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import jax
import numpy as np
import pandas as pd
import pytest
from gymnasium.vector import AsyncVectorEnv
from jax import numpy as jnp

from ms_highway import plan
from ms_highway.envs import ENVIRONMENTS, SCENARIOS
from ms_highway.envs.stage import evaluate
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.game.game import move, swap_players, total_reward, trajectory_reward
from ms_highway.game.reward import FEATURES, OWN_FEATURES, PAPER_FEATURES, add_feature, linear_reward, weight_names
from ms_highway.game.scenario import build_game, driving_game
from ms_highway.metareasoning.switching import _expand
from ms_highway.optimization.second_derivatives import response
from ms_highway.planning.compiled_plans import CompiledPlans, checked_state
from ms_highway.planning.human_models import TheoryOfMind
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.packing import pack

STEP = 1e-2  # of scaled controls, for differences in single precision


@pytest.fixture(scope="module")
def roomy():
    """The module of a user's, whose scenario and feature are forgotten afterwards."""
    module = import_module("roomy")
    yield module
    del ENVIRONMENTS["roomy"], SCENARIOS["roomy"], OWN_FEATURES["room"], sys.modules["roomy"]


@pytest.fixture(autouse=True)
def forgotten(roomy):
    """Features that a test adds are gone after it."""
    before = dict(OWN_FEATURES)
    yield
    OWN_FEATURES.clear()
    OWN_FEATURES.update(before)


def differences(function, point):
    """Central differences of a function, in every entry of the point; those come last."""
    steps = STEP * np.eye(point.size, dtype=np.float32).reshape(-1, *point.shape)
    slopes = [(np.asarray(function(point + step)) - np.asarray(function(point - step))) / (2 * STEP) for step in steps]
    return np.stack(slopes, axis=-1).reshape(*slopes[0].shape, *point.shape)


def close(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, atol=tolerance * np.abs(expected).max(), rtol=0)


def started(played, roomy, horizon):
    """The game of the user's scenario, a start with the cars close to each other, and controls of both."""
    game, state = played(roomy.RoomyEnv.scenario)
    controls = np.random.default_rng(0).normal(0, 0.3, (2, horizon, 2)).astype(np.float32)
    return game, state.at[0, 0].add(-3.0), controls


def test_the_slope_of_a_plan_is_that_of_differences(played, roomy):
    game, state, controls = started(played, roomy, 5)
    assert game.robot.names == game.humans.names == (*PAPER_FEATURES, "room")

    def earned(both):
        return total_reward(game, state, both[0], both[1:])

    room = replace(game.robot, weights=jnp.zeros(11).at[-1].set(30.0))
    of_room = replace(game, robot=room)
    alone = jit_quickly(jax.grad(lambda both: total_reward(of_room, state, both[0], both[1:])))(controls)
    assert np.abs(alone).max() > 0.1, "the feature should matter here"
    close(jit_quickly(jax.grad(earned))(controls), differences(jit_quickly(earned), controls), 5e-3)


def test_decisions_expand_a_feature_that_looks_at_everything_at_once(played, roomy):
    """Other cars and cones, which are left out of the package's own, change how the feature depends on the human."""
    game, state, controls = started(played, roomy, 1)
    robot, human = controls[:, 0]

    @jit_quickly
    def slopes(both):
        return jax.grad(lambda both: total_reward(game, state, both[:1], both[None, 1:]))(both)

    both = controls[:, 0]
    slope, bend = slopes(both), differences(slopes, both)
    expansion = jit_quickly(_expand)(game, state, robot, human)
    close([expansion.robot, expansion.human], slope, 1e-3)
    close(expansion.robot_robot, bend[0, :, 0], 5e-3)
    close(expansion.robot_human, bend[0, :, 1], 5e-3)
    close(expansion.human_human, bend[1, :, 1], 5e-3)


@pytest.mark.slow
def test_theory_of_mind_steps_along_differences_of_both_slopes(played, roomy):
    game, state, _ = started(played, roomy, 5)
    still = np.zeros((5, 2), np.float32)
    mirrored, mirrored_state = swap_players(game, state)
    slope_robot, slope_human = jit_quickly(jax.grad(total_reward, argnums=(2, 3)))(game, state, still, still[None])

    @jit_quickly
    def slope_of_human(robot, human):
        return jax.grad(total_reward, argnums=2)(mirrored, mirrored_state, human, robot[None])

    own = differences(lambda human: slope_of_human(still, human), still).reshape(10, 10)
    mixed = differences(lambda robot: slope_of_human(robot, still), still).reshape(10, 10)
    pushed = response("damped", jnp.asarray((own + own.T) / 2), slope_human.ravel())
    expected = 0.03 * (np.asarray(slope_robot) + (mixed.T @ np.asarray(pushed)).reshape(5, 2))
    once = replace(game, planner=replace(game.planner, iterations=1))
    step, _ = CompiledPlans(once, [TheoryOfMind()]).plan(checked_state(state), [0])
    close(step.robot, expected, 2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["tom", "switching:0.1"])
def test_a_robot_that_is_paid_for_it_drives_for_it(roomy, controller):
    rooms = {}
    for weight in (30.0, 0.0):
        env = make_environment("roomy", controller).unwrapped
        env.game = replace(
            env.game, robot=replace(env.game.robot, weights=jnp.asarray(env.game.robot.weights).at[-1].set(weight))
        )
        env.reset(seed=0)
        scene, rooms[weight], gains = env.game.scene, [], set()
        for _ in range(40):
            _, reward, _, _, info = env.step(0)
            near = np.concatenate([env.car_states[1:, :2], scene.obstacles])
            squares = np.sum((env.car_states[0, :2] - near) ** 2, axis=-1) / float(scene.length_unit) ** 2
            rooms[weight].append(-np.log(np.exp(-squares).sum()))
            assert info["rewards"]["room"] == pytest.approx(weight * rooms[weight][-1], abs=1e-3)
            assert reward == pytest.approx(sum(info["rewards"].values()))
            gains |= info["gains"].keys()
        assert ("tom" in gains) == (controller != "tom")
    assert rooms[30.0][-1] > rooms[0.0][-1] + 0.01


@pytest.mark.slow
def test_batches_earn_what_the_environment_does(roomy):
    comparison = Comparison({"roomy": ["naive"]}, seeds=2, config={"ladder": ["naive"]})
    found = simulated(comparison)
    env = make_environment("roomy", "naive", ladder=["naive"])
    expected = [record["reward"] for seed in range(2) for record in episode(env, seed)]
    np.testing.assert_allclose(found["reward"], expected, atol=1e-3)


def test_humans_can_drive_for_it(roomy):
    weights = {"speed": 1.0, "lane_alignment": 10.0, "room": 5.0}
    env = gym.make("ms-highway/merger-v0", config={"human_reward": weights}).unwrapped
    assert env.game.humans.names[-1] == "room"
    assert env.game.humans.weights[0, -1] == 5.0
    assert env.game.robot.weights[-1] == 0.0


def test_what_nobody_weighs_is_not_computed(played):
    def counted(scene, own, others):
        calls.append(own)
        return own.speed

    def lowered():
        game, state = played("merger")
        paths = (jax.eval_shape(move, game, car, jnp.zeros((5, 2))) for car in state[:2])
        return (
            jax.jit(trajectory_reward.__wrapped__)
            .lower(game, state, next(paths), jax.ShapeDtypeStruct((1, 5, 5), jnp.float32))
            .as_text()
        )

    calls, before = [], lowered()
    add_feature("counted", counted)
    calls.clear()
    assert lowered() == before
    assert linear_reward({"counted": 0.0, "speed": 1.0}, 20.0).names == PAPER_FEATURES
    assert not calls
    assert linear_reward({"counted": 1.0, "headway": 1.0}, 20.0).names == (*FEATURES, "counted")


def test_a_feature_that_is_added_again_is_computed_anew(played):
    game, state = played("merger")
    found = []
    for sign in (1.0, -1.0):
        add_feature("haste", lambda scene, own, others, sign=sign: sign * own.speed)
        haste = linear_reward({"haste": 1.0}, 20.0)
        plays = driving_game(game.scene, 20.0, {"haste": 1.0, "lane_alignment": 1.0})
        planned = plan(plays, np.asarray(state), "naive").robot
        found.append((float(evaluate(game.scene, haste, state)[1, -1]), planned[0, 1]))
    (one, faster), (other, slower) = found
    assert one == -other > 10
    assert slower < 0 < faster


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)])
def test_a_feature_sees_one_moment_at_a_time(played, shape):
    game, state = played("merger")
    add_feature("nearby", lambda scene, own, others: jnp.max(others.x) > own.x)  # over cars, not over times
    reward = linear_reward({"nearby": 3.0}, 20.0)
    ahead = jnp.linspace(-40.0, 40.0, max(1, np.prod(shape, dtype=int))).reshape(shape)
    states = jnp.broadcast_to(state, (*shape, *state.shape)).at[..., 0, 0].set(ahead)
    terms = jax.vmap(evaluate, in_axes=(None, None, 0))(game.scene, reward, states.reshape(-1, *state.shape))[:, 1, -1]
    np.testing.assert_array_equal(terms.reshape(shape), 3.0 * (ahead < float(state[1:, 0].max())))


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        ("speed", lambda scene, own, others: own.speed, "cannot be called 'speed'; choose one word other than"),
        ("comfort_steering", lambda scene, own, others: own.speed, "cannot be called 'comfort_steering'"),
        ("computation", lambda scene, own, others: own.speed, "cannot be called 'computation'"),
        ("two words", lambda scene, own, others: own.speed, "cannot be called 'two words'"),
        (3, lambda scene, own, others: own.speed, "cannot be called 3"),
        (
            "own",
            lambda scene, own, others: others.speed,
            r"'own' returns float32 of shape \(3,\) .* must return one number",
        ),
        ("own", lambda scene, own, others: None, "'own' returns NoneType .* it must return one number"),
        ("own", lambda scene, own, others: own, "'own' returns Motion.* it must return one number"),
        ("own", lambda scene, own, others: 1j * own.speed, "'own' returns complex64 of shape"),
        ("own", lambda scene, own: own.speed, "'own' cannot be computed: TypeError: .*give a function of"),
        ("own", lambda scene, own, others: float(own.speed), "'own' cannot be computed: Concretization.* jax.numpy"),
        ("own", lambda scene, own, others: np.cos(own.speed), "'own' cannot be computed: TracerArray.* jax.numpy"),
        ("own", 3.0, "'own' cannot be computed: TypeError"),
    ],
)
def test_a_name_that_is_taken_and_a_function_of_no_use_are_refused(name, function, message):
    before = weight_names()
    with pytest.raises(ValueError, match=message):
        add_feature(name, function)
    assert weight_names() == before


def test_a_weight_of_a_feature_that_is_not_known_or_not_computed_is_refused():
    with pytest.raises(ValueError, match=r"unknown reward features \['rom'\].*room.*--import the module that does"):
        linear_reward({"rom": 1.0}, 20.0)
    with pytest.raises(ValueError, match="room would not be computed; add them to the names"):
        linear_reward({"room": 1.0}, 20.0, names=PAPER_FEATURES)


def test_a_game_with_it_is_pickled_and_equal(roomy):
    game = build_game(roomy.RoomyEnv.scenario)
    again = pickle.loads(pickle.dumps(game))
    assert pack(again).layout == pack(game).layout
    assert again.robot.own == (roomy.room,)


@pytest.mark.slow
def test_a_spawned_worker_finds_it_by_the_module_in_the_id(roomy):
    config = {"controller": {"type": "fixed", "model": "naive"}}
    envs = AsyncVectorEnv([lambda: gym.make("roomy:ms-highway/roomy-v0", config=config)], context="spawn")
    try:
        envs.reset(seed=[0])
        rewards, infos = envs.step(np.zeros(1, dtype=int))[1::3]
    finally:
        envs.close()
    env = gym.make("ms-highway/roomy-v0", config=config)
    env.reset(seed=0)
    reward, info = env.step(0)[1::3]
    assert rewards[0] == pytest.approx(reward, abs=1e-5)
    assert infos["rewards"]["room"][0] == pytest.approx(info["rewards"]["room"], abs=1e-5) != 0


@pytest.mark.slow
def test_a_command_finds_it_in_a_module_that_it_imports(roomy, tmp_path):
    controllers = ["--controllers", "naive", "--seeds", "1", "--set", "ladder=naive", "--set", "costs=naive=0.1"]
    command = [sys.executable, "-m", "ms_highway", "--import", "roomy", "compare", "roomy", *controllers]
    subprocess.run([*command, "--out", str(tmp_path)], cwd=Path(__file__).parent, check=True, capture_output=True)
    earned = [record["reward"] for record in episode(make_environment("roomy", "naive"), 0)]
    assert pd.read_csv(tmp_path / "summary.csv")["reward"].item() == pytest.approx(np.mean(earned), abs=1e-3)
