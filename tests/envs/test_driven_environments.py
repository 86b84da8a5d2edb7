"""The robot in highway-env's own environments."""

import subprocess
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import registry
from highway_env.vehicle.kinematics import Vehicle

import ms_highway
from ms_highway.envs.graphics import PAPER, model_color
from ms_highway.envs.road.graphics import PANEL

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

UNDRIVABLE = ("parking-v0", "parking-ActionRepeat-v0", "parking-parked-v0", "lane-keeping-v0")
STOCK = [name for name, spec in registry.items() if "highway_env" in str(spec.entry_point) and name not in UNDRIVABLE]
CONTINUOUS = {"action": {"type": "ContinuousAction"}, "policy_frequency": 5}


def total_accelerations(env):
    """A list that fills with the total acceleration of the controlled vehicle in every frame in which it is whole."""
    road, vehicle, found = env.unwrapped.road, env.unwrapped.vehicle, []
    move = road.step

    def watched(dt):
        before = vehicle.velocity
        move(dt)
        if not vehicle.crashed:
            found.append(np.linalg.norm(vehicle.velocity - before) / dt)

    road.step = watched
    return found


def equal(one, other):
    return all(map(np.array_equal, one, other)) if isinstance(one, tuple) else np.array_equal(one, other)


@pytest.mark.parametrize("name", STOCK)
def test_the_robot_drives_every_stock_environment_within_its_grip_and_leaves_the_rest_as_it_is(name):
    stock, env = gym.make(name), ms_highway.drive(gym.make(name))
    assert (env.action_space, env.observation_space) == (stock.action_space, stock.observation_space)
    observation, info = env.reset(seed=1)
    assert equal(observation, stock.reset(seed=1)[0])
    assert info["road"]["decisions"] == []
    accelerations = total_accelerations(env)
    frames = int(env.unwrapped.config["simulation_frequency"] // env.unwrapped.config["policy_frequency"])
    observation, reward, terminated, _, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert np.isfinite(reward).all()
    assert not np.any(terminated)
    told = info["road"]
    assert told["source"] in ("refined", "proposal", "last plan", "braking")
    assert all(np.isfinite(told[key]) for key in ("planning_seconds", "decision_seconds", "acceleration", "jerk"))
    assert set(told["rungs"]) <= {"", "naive", "idm", "turn", "tom"}
    assert told["belief"] is told["traits"] is None
    assert len(accelerations) == frames
    assert told["acceleration"] >= max(accelerations) - 1e-9
    assert max(accelerations) <= 5.0
    assert env.unwrapped.time * env.unwrapped.config["policy_frequency"] == pytest.approx(1)


def test_it_plans_five_times_a_second_whatever_the_policy_frequency_is():
    for frequency in (1, 5):
        env = ms_highway.drive(gym.make("merge-v0", config={"policy_frequency": frequency}))
        env.reset(seed=0)
        assert [len(env.step(0)[4]["road"]["decisions"]) for _ in range(2)] == [5 // frequency] * 2


def test_actions_change_nothing():
    episodes = []
    for action in (0, 3):
        env = ms_highway.drive(gym.make("highway-fast-v0"), {"driver": "fixed:naive"})
        env.reset(seed=0)
        episodes.append([env.step(action) for _ in range(3)])
    for one, other in zip(*episodes, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
        assert (one[1], one[4]["action"]) == (other[1], 1)  # of which highway-env thinks that it is idle


@pytest.mark.parametrize("config", [{}, CONTINUOUS])
def test_a_reset_below_the_wrapper_leaves_no_robot_in_the_car_and_the_error_says_so(config):
    env = ms_highway.drive(gym.make("highway-fast-v0", config=config))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(None)
    env.reset(seed=0)
    env.env.reset(seed=1)
    with pytest.raises(gym.error.ResetNeeded, match="call reset of the driven environment"):
        env.step(None)


def test_a_time_limit_in_steps_is_kept():
    env = ms_highway.drive(gym.make("two-way-v0"), {"driver": "proposals"})
    env.reset(seed=0)
    ends = [env.step(1)[2:4] for _ in range(15)]
    assert ends == [(False, False)] * 14 + [(False, True)]


def test_every_controlled_vehicle_is_driven():
    env = ms_highway.drive(gym.make("intersection-multi-agent-v0"), {"driver": "fixed:naive"})
    env.reset(seed=0)
    base = env.unwrapped
    assert env.robots == base.controlled_vehicles
    assert [each.controlled_vehicle for each in base.action_type.agents_action_types] == env.robots
    assert [each.observer_vehicle for each in base.observation_type.agents_observation_types] == env.robots
    env.step((0, 0))
    assert all(len(robot.steps) == 5 for robot in env.robots)


def test_a_driven_environment_can_be_made_again_from_its_specification():
    env = gym.make(ms_highway.drive(gym.make("merge-v0"), {"price": 0.5}).spec)
    assert env.settings.price == 0.5
    env.reset(seed=0)
    env.step(1)


@pytest.mark.parametrize("name", ["highway-fast-v0", "roundabout-v0"])
def test_a_picture_shows_the_plan_and_the_cars_in_the_colours_of_their_rungs(name):
    env = ms_highway.drive(gym.make(name, render_mode="rgb_array"), {"driver": "fixed:idm"})
    env.reset(seed=0)
    before = env.render()
    _, _, _, _, info = env.step(1)
    frame, height = env.render(), env.unwrapped.config["screen_height"]
    assert before.shape == frame.shape == (height + PANEL, 600, 3)
    assert "idm" in info["road"]["rungs"]
    assert (frame[:height] == model_color("idm")).all(axis=-1).sum() > 100
    assert (frame[height] == PAPER).all()
    assert (frame[height:] != PAPER).any()
    env.close()


def test_a_car_with_several_paths_has_the_colour_of_its_dearest_rung():
    env = ms_highway.drive(gym.make("roundabout-v0", render_mode="rgb_array"), {"driver": "fixed:naive"})
    env.reset(seed=0)
    env.step(1)
    last = env.robots[0].last_step
    owners = last.owners.tolist()
    first = next(path for path, owner in enumerate(owners) if owner >= 0 and owners.count(owner) > 1)
    rungs = tuple("tom" if path == first else rung for path, rung in enumerate(last.rungs))
    env.robots[0].last_step = replace(last, rungs=rungs)
    assert (env.render() == model_color("tom")).all(axis=-1).sum() > 200  # the body, beside the dots of one path
    env.close()


def test_a_plan_that_is_none_is_not_drawn():
    env = ms_highway.drive(gym.make("merge-v0", render_mode="rgb_array"), {"driver": "fixed:naive"})
    env.reset(seed=0)
    robot = env.robots[0]
    scene = replace(robot.look(), robot=np.full(4, np.nan, np.float32))
    robot.look = lambda: scene
    assert env.step(1)[4]["road"]["source"] == "braking"
    assert env.render().shape == (150 + PANEL, 600, 3)
    env.close()


@pytest.mark.parametrize("outside", [True, False])
def test_pictures_are_collected_inside_and_outside_of_the_wrapper(outside):
    env = gym.make("merge-v0", render_mode="rgb_array")
    collect = gym.wrappers.RenderCollection
    env = collect(ms_highway.drive(env)) if outside else ms_highway.drive(collect(env))
    env.reset(seed=0)
    env.step(1)
    shapes = {frame.shape for frame in env.render()}
    assert shapes == {(150 + PANEL, 600, 3)}


@pytest.mark.parametrize("outside", [True, False])
def test_videos_have_every_frame_of_the_simulation(outside, tmp_path):
    pytest.importorskip("moviepy", reason="moviepy, which Gymnasium records with, is not installed")

    def record(env):
        return gym.wrappers.RecordVideo(env, str(tmp_path / "films"), episode_trigger=lambda episode: True)

    env = gym.make("merge-v0", render_mode="rgb_array")
    env = record(ms_highway.drive(env)) if outside else ms_highway.drive(record(env))
    recorder = env if outside else env.env
    env.unwrapped.set_record_video_wrapper(recorder)
    env.reset(seed=0)
    env.step(1)
    env.step(1)
    assert len(recorder.recorded_frames) == 1 + 2 * 15
    env.close()
    assert list(tmp_path.glob("films/*.mp4"))


def test_vector_environments_are_driven():
    envs = gym.vector.SyncVectorEnv(
        [lambda: ms_highway.drive(gym.make("highway-fast-v0"), {"driver": "fixed:idm"})] * 2
    )
    envs.reset(seed=[5, 5])
    for _ in range(2):
        observations, rewards, _, _, infos = envs.step(envs.action_space.sample())
    np.testing.assert_array_equal(*observations)
    assert rewards[0] == rewards[1]
    assert (infos["road"]["acceleration"] <= 5.0).all()


VECTOR = """
import gymnasium as gym
import ms_highway


def make():
    ms_highway.keep_compilations()
    return ms_highway.drive(gym.make("highway-fast-v0"), {"driver": "fixed:naive"})


if __name__ == "__main__":
    envs = gym.vector.AsyncVectorEnv([make, make], context="spawn")
    envs.reset(seed=[5, 5])
    observations, rewards, _, _, infos = envs.step(envs.action_space.sample())
    envs.close()
    assert (observations[0] == observations[1]).all()
    assert (infos["road"]["planning_seconds"] > 0).all()
"""


FORKED = """
import multiprocessing
import warnings

import gymnasium as gym
import ms_highway
from jax import numpy as jnp

jnp.ones(3).sum()
env = ms_highway.drive(gym.make("highway-fast-v0"))
env.reset(seed=0)
warnings.simplefilter("ignore")  # JAX and Python warn of the fork


def work():
    try:
        env.step(1)
    except RuntimeError as error:
        print(error, flush=True)


worker = multiprocessing.get_context("fork").Process(target=work)
worker.start()
worker.join()
"""


def test_a_worker_that_was_forked_after_jax_had_begun_says_so_instead_of_waiting_for_ever():
    done = subprocess.run([sys.executable, "-c", FORKED], timeout=600, capture_output=True, text=True)
    assert "start it with context='forkserver' or 'spawn'" in done.stdout


@pytest.mark.slow
def test_workers_of_a_vector_environment_drive(tmp_path):
    script = tmp_path / "vector.py"
    script.write_text(VECTOR)
    done = subprocess.run([sys.executable, script], timeout=600, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_policy_drives_an_environment_that_stays_stock():
    env = gym.make("highway-fast-v0", config=CONTINUOUS)
    policy = ms_highway.RoadPolicy(env, {"driver": "fixed:idm"})
    for seed in (0, 1):
        observation, _ = env.reset(seed=seed)
        assert type(env.unwrapped.vehicle) is Vehicle
        for _ in range(20):
            action, state = policy.predict(observation, deterministic=True)
            assert env.action_space.contains(action)
            observation, _, terminated, _, _ = env.step(action)
            assert not terminated
            control = policy.steps[0].control
            assert env.unwrapped.vehicle.action["acceleration"] == pytest.approx(control[1], abs=0.2)
        assert state is None
        assert env.unwrapped.vehicle.on_road


def test_a_policy_answers_a_batch_of_one_with_a_batch_of_one():
    env = gym.make("highway-fast-v0", config=CONTINUOUS)
    policy = ms_highway.RoadPolicy(env, {"driver": "fixed:naive"})
    observation, _ = env.reset(seed=0)
    action, _ = policy.predict(observation)
    actions, _ = policy.predict(observation[None], episode_start=np.ones(1, dtype=bool))
    assert actions.shape == (1, 2)
    np.testing.assert_array_equal(actions[0], action)


def test_a_policy_of_several_environments_answers_with_one_action_each():
    envs = gym.vector.SyncVectorEnv([lambda: gym.make("highway-fast-v0", config=CONTINUOUS)] * 2)
    policy = ms_highway.RoadPolicy(envs, {"driver": "fixed:naive"})
    observations, _ = envs.reset(seed=[5, 5])
    for _ in range(3):
        actions, _ = policy.predict(observations, episode_start=np.zeros(2, dtype=bool))
        assert actions.shape == (2, 2)
        np.testing.assert_array_equal(*actions)
        observations, *_ = envs.step(actions)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"policy_frequency": 5}, "needs continuous actions, not DiscreteMetaAction; make it with"),
        ({**CONTINUOUS, "policy_frequency": 1}, "needs 4 actions per second or more, not 1; make it with"),
        ({**CONTINUOUS, "action": {"type": "ContinuousAction", "longitudinal": False}}, "longitudinal and lateral"),
    ],
)
def test_a_policy_refuses_what_it_cannot_drive_and_says_how_to_make_it(config, message):
    with pytest.raises(ValueError, match=message):
        ms_highway.RoadPolicy(gym.make("highway-fast-v0", config=config))


def test_a_policy_of_nothing_is_refused():
    with pytest.raises(ValueError, match="str is neither an environment"):
        ms_highway.RoadPolicy("highway-fast-v0")


def test_belief_and_traits_are_told_and_shown_where_they_are_configured():
    config = {"driver": "proposals", "belief": True, "traits": True}
    env = ms_highway.drive(gym.make("merge-v0", render_mode="rgb_array"), config)
    env.reset(seed=0)
    told = env.step(0)[4]["road"]
    present = np.array(told["rungs"]) != ""
    np.testing.assert_allclose(told["belief"].sum(axis=1), 1.0, atol=1e-6)
    assert (np.abs(told["belief"][present] - 0.25) > 0.01).any()
    assert ((told["traits"].speed > 1) & (told["traits"].headway > 0.2)).all()
    robot, believed = env.unwrapped.vehicle, env.render()
    robot.last_step = replace(robot.last_step, belief=None)
    assert (believed != env.render()).any()
