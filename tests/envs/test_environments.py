"""The environments as a Gymnasium user meets them."""

import pickle
import subprocess
import sys
import warnings
from dataclasses import replace
from importlib import reload

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium.utils.env_checker import check_env

import ms_highway
from ms_highway.envs import SCENARIOS, MergerEnv, add_scenario, environment_id
from ms_highway.envs.stage import Timing
from ms_highway.game.learned_reward import shipped
from ms_highway.game.reward import COMFORT, FEATURES
from ms_highway.game.scenario import COMMON_WEIGHTS, PAPER_UNIT

ACTIONS = {
    "autopilot": {"type": "Autopilot"},
    "human_model": {"type": "HumanModelAction", "lambda": 0.1},
    "continuous": {"type": "ContinuousAction"},
}
FIXED = {"type": "fixed", "model": "naive"}
TO_METRES = np.array([PAPER_UNIT, PAPER_UNIT, 1.0, PAPER_UNIT])


def make(scenario, render_mode=None, **config):
    return gym.make(environment_id(scenario), render_mode=render_mode, config=config)


def drive(env, seed=0, options=None, action=0):
    """States before the first and after every step, and the rewards and infos of a whole episode."""
    env.reset(seed=seed, options=options)
    states, rewards, infos, done = [env.unwrapped.car_states], [], [], False
    while not done:
        _, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        states.append(env.unwrapped.car_states)
        rewards.append(reward)
        infos.append(info)
    return np.array(states), np.array(rewards), infos


@pytest.mark.parametrize("action", ACTIONS)
def test_gymnasiums_checker_passes_without_a_warning(scenario, action):
    env = make(scenario, "rgb_array", action=ACTIONS[action], controller=FIXED)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_ids_are_registered_once_and_for_good():
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Gymnasium warns when an id is registered again
        reload(ms_highway)
    assert all(environment_id(name).removeprefix("ms_highway:") in gym.registry for name in SCENARIOS)


def test_episodes_have_the_papers_length_at_ten_hertz(scenario):
    env = make(scenario, controller=FIXED)
    states, rewards, infos = drive(env)
    assert len(rewards) == {"stay_back": 35, "merger": 40, "give_way": 40}[scenario]
    travelled = states[-1, 1, 0] - states[0, 1, 0]
    assert travelled == pytest.approx(len(rewards) * 0.1 * states[:, 1, 3].mean(), rel=0.05)
    assert infos[-1]["collision_effect"] == "reward only"


def test_the_same_seed_gives_the_same_episode_and_another_one_another():
    env = make("merger")
    first, again, other = drive(env, 7), drive(env, 7), drive(env, 8)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert [info["model"] for info in first[2]] == [info["model"] for info in again[2]]
    assert abs(first[0] - other[0]).max() > 1e-3


def test_starts_have_the_noise_of_the_papers_experiments():
    env = make("merger")
    states = []
    for seed in range(300):
        env.reset(seed=seed)
        states.append(env.unwrapped.car_states / TO_METRES)
    spread = np.std(states, axis=0)
    np.testing.assert_allclose(spread[:, 1], 5e-4, rtol=0.15)
    np.testing.assert_allclose(spread[:, 2:], 1e-3, rtol=0.15)
    np.testing.assert_allclose(spread[:, 0], [np.hypot(0.01, 5e-4), 5e-4, 5e-4], rtol=0.15)


def test_initial_states_can_be_given_and_are_checked():
    env = make("merger", controller=FIXED)
    given = np.array([[0, 0, 0.0, 19.0], [-5, -3.3, 0.01, 20.0], [8, -3.3, 0.0, 21.0]])
    env.reset(options={"initial_states": given})
    np.testing.assert_array_equal(env.unwrapped.car_states, given)
    with pytest.raises(ValueError, match=r"shape \(2, 4\); merger needs \(3, 4\)"):
        env.reset(options={"initial_states": given[:2]})
    with pytest.raises(ValueError, match="not finite"):
        env.reset(options={"initial_states": given * np.nan})
    with pytest.raises(ValueError, match="initial_state"):
        env.reset(options={"initial_state": given})


@pytest.mark.parametrize("name", ["merger__naive", "merger__turn", "give_way__naive", "give_way__turn"])
def test_released_semantics_follow_the_logged_cars(reference, name):
    scenario, model = name.split("__")
    env = make(scenario, semantics="released", controller={"type": "fixed", "model": model})
    with np.load(reference / f"{name}.npz") as logs:
        logged, rewards = logs["states"], logs["rewards"]
    for run in range(3):
        states, earned, _ = drive(env, options={"initial_states": logged[run, 0] * TO_METRES})
        np.testing.assert_allclose(states[:-1] / TO_METRES, logged[run], atol=1e-3)
        np.testing.assert_allclose(earned, rewards[run], atol=1e-2)


def test_switching_thinks_harder_to_merge_and_earns_more_than_naive():
    _, naive, _ = drive(make("merger", controller=FIXED))
    _, switching, infos = drive(make("merger"))
    assert switching.mean() > naive.mean() + 3
    models = [info["model"] for info in infos]
    assert set(models) == {"naive", "turn", "tom"}
    switched = [
        info for before, info in zip(models, infos[1:], strict=False) if info["model"] not in (before, "turn", "naive")
    ]
    assert switched
    assert all(info["gains"]["tom"] > 0 for info in switched)


def test_info_tells_reward_by_feature_and_measured_times():
    _, rewards, infos = drive(make("merger", controller={"type": "fixed", "model": "turn"}))
    for reward, info in zip(rewards, infos, strict=True):
        assert sum(info["rewards"].values()) == pytest.approx(reward)
        assert info["status"] == info["human_status"] == "planned"
        assert 0 < info["timing"].planning_seconds < 1
        assert info["collision"] is False


def test_the_agent_that_chooses_the_model_pays_for_its_time():
    free = make("merger", action={"type": "HumanModelAction", "lambda": 0.0})
    dear = make(
        "merger", action={"type": "HumanModelAction", "lambda": 2.0}, costs={"naive": 0.1, "turn": 0.2, "tom": 0.5}
    )
    for place, (name, seconds) in enumerate({"naive": 0.1, "turn": 0.2, "tom": 0.5}.items()):
        outcomes = []
        for env in (free, dear):
            env.reset(seed=1)
            outcomes.append(env.step(place))
        assert outcomes[0][4]["model"] == name
        assert outcomes[0][1] - outcomes[1][1] == pytest.approx(2.0 * seconds)
        assert sum(outcomes[1][4]["rewards"].values()) == pytest.approx(outcomes[1][1])


def test_the_agent_that_chooses_the_model_waits_for_compilation_only_once():
    env = make("merger", action={"type": "HumanModelAction", "lambda": 0.1})
    env.reset(seed=0)
    assert [env.step(place)[4]["timing"].compile_seconds for place in (0, 1, 2)][1:] == [0.0, 0.0]


def test_the_autopilot_refuses_other_actions():
    env = make("merger", controller=FIXED).unwrapped
    with pytest.raises(ValueError, match="action 7 is not 0"):
        env.step(7)


def test_a_continuous_action_drives_the_robot():
    env = make("merger", action={"type": "ContinuousAction"})
    env.reset(seed=0)
    speed = env.unwrapped.robot.speed
    env.step(np.array([1.0, 0.0]))  # 5 m/s^2 against 0.2 1/s of friction
    assert env.unwrapped.robot.speed == pytest.approx(speed + 0.1 * (5.0 - 0.2 * speed))


def test_a_horizon_of_a_second_is_planned_with_steps_that_hold():
    env = make("merger", controller={"type": "fixed", "model": "turn"}, horizon=10)
    _, rewards, infos = drive(env)
    planner = env.unwrapped.game.planner
    assert (planner.horizon, planner.iterations) == (10, 58)
    assert len(env.unwrapped.robot.last_step.plan) == len(env.unwrapped.human.last_step.plan) == 10
    assert rewards.mean() > 1.3
    assert not any(info["collision"] for info in infos)
    with pytest.warns(UserWarning, match=r"step_size'\] is 0.03: plans of 10 steps of 0.1 s overshoot") as warned:
        env = gym.make(environment_id("merger"), config={"horizon": 10, "step_size": 0.03})
    assert len(warned) == 1
    env.close()


def test_a_controller_that_is_set_in_the_configuration_itself_drives_from_the_next_reset_on():
    env = make("merger", controller=FIXED)
    env.unwrapped.config["controller"] = {"type": "fixed", "model": "turn"}
    env.reset(seed=0)
    assert env.step(0)[-1]["model"] == "turn"


def test_a_longer_time_step_makes_fewer_steps_of_the_same_episode():
    env = make("merger", controller=FIXED, time_step=0.2, horizon=3)
    states, rewards, _ = drive(env)
    assert len(rewards) == 20
    assert env.unwrapped.metadata["render_fps"] == 5
    travelled = states[-1, 2, 0] - states[0, 2, 0]
    assert travelled == pytest.approx(4.0 * states[0, 2, 3], rel=1e-3)


def test_a_collision_costs_reward_is_reported_and_ends_the_episode_only_if_asked():
    starts = np.array([[0, 0, 0.0, 20.0], [-8, -3.3, 0.0, 20.0], [3, 0.0, 0.0, 20.0]])
    for terminate in (False, True):
        env = make("merger", controller=FIXED, terminate_on_collision=terminate)
        env.reset(options={"initial_states": starts})
        _, reward, terminated, _, info = env.step(0)
        assert info["collision"]
        assert info["crashed"]
        assert reward < -90
        assert terminated is terminate
        np.testing.assert_allclose(env.unwrapped.car_states[2], starts[2] + [2.0, 0, 0, 0])  # no push, no freeze


def test_observations_stay_in_their_space_and_name_the_cars_by_role():
    env = make("give_way", controller=FIXED)
    observation, _ = env.reset(seed=0)
    assert observation.flags.c_contiguous
    assert np.isfinite(env.observation_space.low).all()
    assert np.isfinite(env.observation_space.high).all()
    x, y, _, speed = env.unwrapped.car_states[1] - env.unwrapped.car_states[0]
    np.testing.assert_allclose(observation[1, :3], [x / 100, y / 10, speed / 40], atol=1e-4)
    for _ in range(40):
        observation, *_ = env.step(0)
        assert env.observation_space.contains(observation)


def test_an_action_space_keeps_its_seed_across_resets():
    env = make("merger", action=ACTIONS["human_model"]).unwrapped
    env.action_space.seed(5)
    space = env.action_space
    env.reset(seed=0)
    assert env.action_space is space


def test_frame_rates_do_not_leak_between_environments():
    env = make("merger")
    shared = dict(type(env.unwrapped).metadata)
    env.reset()
    assert env.unwrapped.metadata["render_fps"] == 10
    assert type(env.unwrapped).metadata == shared


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"semantic": "paper"}, "unknown key 'semantic' in config; did you mean 'semantics'"),
        ({"controller": {"type": "fixed", "model": "oracle"}}, "'oracle'; the human models are naive, turn, tom"),
        ({"controller": {"type": "switching", "lambda": -1}}, r"\['lambda'\] is -1"),
        ({"controller": {"lamda": 1}}, "did you mean 'lambda'"),
        ({"controller": {"type": "fixed"}}, "'model'"),
        ({"controller": {"type": "schedule", "models": []}}, r"\['models'\] is \[\]; give a list of human models"),
        ({"controller": {"type": "schedule", "models": ["tom", "oracle"]}}, "'oracle'.*of naive, turn, tom"),
        ({"controller": {"type": "period"}}, r"\['models'\] is None; give a list of human models"),
        ({"controller": {"type": "random"}}, r"\['shares'\] is None; give the share of each model, such as"),
        (
            {"controller": {"type": "random", "shares": {"oracle": 1.0}}},
            r"\['shares'\] names 'oracle'; the human models",
        ),
        ({"controller": {"type": "random", "shares": {"tom": -0.5, "naive": 1.5}}}, r"\['shares'\]\['tom'\] is -0.5"),
        ({"controller": {"type": "random", "shares": {"tom": np.inf}}}, r"\['tom'\] is inf; a share must be a number"),
        (
            {"controller": {"type": "random", "shares": {"tom": 0.3, "naive": 0.6}}},
            r"\['shares'\] sum to 0.9; change one",
        ),
        ({"controller": "tom"}, "'type' must be one of"),
        ({"ladder": ["tom", "naive"]}, "cheapest first"),
        ({"ladder": []}, "impossible ladder"),
        ({"costs": "free"}, "'free'; say 'published'"),
        ({"costs": {"naive": 0.1}}, "has no seconds for 'turn'"),
        ({"semantics": "real"}, "choose one of 'paper', 'released'"),
        ({"influence": "none"}, "'influence'"),
        (
            {"human_reward": "taught"},
            "'human_reward'.* is 'taught'; say 'learned', 'published', or give weights by name",
        ),
        ({"human_reward": {"sped": 2.0}}, r"'sped' in config\['human_reward'\]; did you mean 'speed'"),
        (
            {"human_reward": {"speed": np.nan}},
            r"config\['human_reward'\]\['speed'\] is nan; it must be a finite number",
        ),
        ({"human_reward": {"speed": "2"}}, r"\['speed'\] is '2'"),
        ({"policy_frequency": 5}, "must be 10"),
        ({"horizon": 0}, r"\['horizon'\] is 0"),
        ({"horizon": 10**6}, "must be a whole number from 1 to 100"),
        ({"iterations": 2.5}, r"\['iterations'\] is 2.5; it must be a whole number from 1 to 5000"),
        ({"iterations": 10**12}, "from 1 to 5000"),
        ({"horizon": 50}, "need 36385 gradient steps"),
        ({"time_step": 1e-320}, "from 0.01 to 1 s"),
        ({"duration": 0.01}, "one time step at least"),
        ({"step_size": -0.1}, r"\['step_size'\] is -0.1"),
        ({"time_step": 0.2, "policy_frequency": 10}, "steps of 0.2 s, so it must be 5"),
        ({"duration": -1}, "'duration'"),
        ({"control_limit": [1.0]}, "'control_limit'"),
        ({"control_limit": ["a", "b"]}, "'control_limit'"),
        ({"control_limit": [0.2, 1e308]}, "'control_limit'"),
        ({"control_limit": np.array(9.0)}, "'control_limit'"),
        ({"control_limit": [[1], [2, 3]]}, "'control_limit'.* or two positive bounds"),
        ({"control_limit": (True, 9)}, "'control_limit'"),
        ({"human_reward": {"speed": 1e39}}, "at most 3.4e"),
        (
            {"controller": {"type": "switching", "lambda": 1e308}},
            r"\['lambda'\] is 1e\+308; it must be a number from 0",
        ),
        ({"action": {"type": "HumanModelAction", "lambda": -1}}, r"\['lambda'\] is -1; it must be a number from 0"),
        ({"costs": np.array([0.1, 0.2, 0.3])}, "'costs'"),
        ({"ladder": "tom"}, "'tom' is one name"),
        ({"terminate_on_collision": "no"}, "must be True or False"),
        ({"screen_width": -3}, "'screen_width'"),
        ({"controller": {"type": ["fixed"]}}, "'type' must be one of"),
        ({"controller": {"model": "tom"}}, "say 'type': 'fixed'"),
        ({"action": {"type": "Teleport"}}, "Teleport"),
        ({"action": {"type": "HumanModelAction", "lamda": 1}}, "did you mean 'lambda'"),
        ({"action": {"type": "ContinuousAction", "clipp": True}}, "did you mean 'clip'"),
        ({"observation": {"type": "Kinematics", "feature": []}}, "did you mean 'features'"),
    ],
)
def test_a_wrong_configuration_is_refused_with_the_remedy(config, message):
    with pytest.raises(ValueError, match=message):
        make("merger", **config)


@pytest.mark.parametrize("name", ["merger", "Zipper", "two words"])
def test_a_scenario_of_ones_own_needs_a_name_of_its_own(name):
    environment = type("Environment", (MergerEnv,), {"scenario": replace(MergerEnv.scenario, name=name)})
    with pytest.raises(ValueError, match=f"cannot be called '{name}'; choose one word in lower case"):
        add_scenario(environment)
    assert list(SCENARIOS) == ["stay_back", "merger", "give_way"]


def test_a_refused_change_leaves_the_configuration_as_it_was():
    env = make("merger").unwrapped
    before = dict(env.config)
    with pytest.raises(ValueError, match="semantics"):
        env.reset(options={"config": {"duration": 1.0, "semantics": "real"}})
    assert env.config == before


def test_a_change_that_highway_env_refuses_leaves_the_environment_usable():
    env = make("merger", controller=FIXED).unwrapped
    paralysed = {"type": "ContinuousAction", "longitudinal": False, "lateral": False}
    with pytest.raises(ValueError, match="control must be enabled"):
        env.reset(options={"config": {"action": paralysed}})
    env.reset(seed=0)
    assert env.step(0)[4]["model"] == "naive"


@pytest.mark.parametrize("kind", ["Kinematics", "OccupancyGrid"])
def test_highway_envs_observations_have_finite_spaces_here(kind):
    env = make("merger", controller=FIXED, observation={"type": kind})
    observation, _ = env.reset(seed=0)
    assert np.isfinite(env.observation_space.low).all()
    assert np.isfinite(env.observation_space.high).all()
    assert env.observation_space.contains(observation)


def test_nested_configurations_merge_and_a_new_type_replaces():
    assert make("merger", controller={"lambda": 3}).unwrapped.config["controller"] == {"type": "switching", "lambda": 3}
    assert make("merger", controller=FIXED).unwrapped.config["controller"] == FIXED


def weights_of(game):
    """The human's reward by name, without zeros."""
    values = zip((*game.human.names, *COMFORT), (*game.human.weights, *game.human.comfort), strict=True)
    return {name: float(value) for name, value in values if value}


@pytest.mark.parametrize(("semantics", "choice"), [("paper", "learned"), ("released", "published")])
def test_humans_drive_for_what_belongs_to_the_semantics(scenario, semantics, choice):
    driving = {"learned": shipped("demonstrations").weights, "published": COMMON_WEIGHTS}[choice]
    aims = {name: weight for name, weight in SCENARIOS[scenario].human_weights.items() if name not in COMMON_WEIGHTS}
    for config in ({"semantics": semantics}, {"semantics": semantics, "human_reward": choice}):
        game = make(scenario, **config).unwrapped.game
        assert weights_of(game) == pytest.approx(driving | aims)
        robot = dict(zip(game.robot.names, game.robot.weights.tolist(), strict=True))
        assert {name: weight for name, weight in robot.items() if weight} == SCENARIOS[scenario].robot_weights


def test_weights_that_are_given_move_the_human_and_the_robots_models_of_it_alike():
    hurried = {"speed": 40.0, "lane_alignment": 75.0, "gap": 0.0}
    own, believed = [], []
    for reward in ("published", hurried):
        env = make("merger", controller={"type": "fixed", "model": "turn"}, human_reward=reward).unwrapped
        env.reset(options={"initial_states": [[0, 0, 0, 20.0], [-30, -3.3, 0, 18.0], [-14, -3.3, 0, 20.0]]})
        env.step(0)
        own.append(env.human.last_step.control)
        believed.append(env.robot.last_step.human[0])
    assert weights_of(env.game) == {"speed": 40.0, "lane_alignment": 75.0, "target_lane": 1000.0}
    np.testing.assert_allclose(own, believed, atol=1e-3)
    assert abs(own[0][1] - own[1][1]) > 0.5


def test_rewards_of_humans_are_replaced_whole():
    env = make("merger", controller=FIXED, human_reward={"speed": 2.0, "off_road": -100.0}).unwrapped
    env.reset(options={"config": {"human_reward": {"speed": 3.0}}})
    assert env.config["human_reward"] == {"speed": 3.0}


def test_other_weights_of_the_human_compile_nothing():
    env = make("merger", controller={"type": "fixed", "model": "turn"}).unwrapped
    env.reset(seed=0)
    env.step(0)
    for reward in ("published", {"speed": 1.0, "lane_alignment": 10.0, "comfort_acceleration": 0.3}):
        env.reset(seed=0, options={"config": {"human_reward": reward}})
        assert env.step(0)[4]["timing"].compile_seconds == 0.0


def test_theory_of_mind_opens_the_gap_with_a_learned_human_and_naive_does_not():
    earned = {}
    for model in ("naive", "tom"):
        env = make("merger", controller={"type": "fixed", "model": model}, human_reward="learned")
        env.reset(seed=0)
        earned[model] = np.mean([env.step(0)[1] for _ in range(40)])
    assert earned["naive"] == pytest.approx(1.5, abs=0.1)
    assert earned["tom"] > 6.0


def test_humans_can_drive_for_what_traffic_needs():
    env = make("merger", controller=FIXED, human_reward=shipped("us101").weights).unwrapped
    env.reset(seed=0)
    info = env.step(0)[4]
    assert info["status"] == info["human_status"] == "planned"
    assert set(FEATURES) <= set(info["rewards"])


def test_an_unknown_scenario_is_refused_by_name():
    with pytest.raises(ValueError, match="'roundabout'; the scenarios are stay_back, merger, give_way"):
        environment_id("roundabout")


VECTOR = """
import gymnasium as gym
import numpy as np

if __name__ == "__main__":
    envs = gym.make_vec(
        "ms_highway:ms-highway/merger-v0",
        num_envs=2,
        vectorization_mode="async",
        vector_kwargs={{"context": {context!r}}},
        config={{"controller": {{"type": "fixed", "model": "naive"}}}},
    )
    envs.reset(seed=[3, 3])
    observations, rewards, _, _, infos = envs.step(np.zeros(2, dtype=int))
    envs.close()
    assert (observations[0] == observations[1]).all()
    assert rewards[0] == rewards[1] != 0
    assert list(infos["model"]) == ["naive", "naive"]
"""


@pytest.mark.parametrize(
    "context", [None, *(pytest.param(name, marks=pytest.mark.slow) for name in ("spawn", "forkserver"))]
)
def test_workers_of_a_vector_environment_find_and_step_the_environments(context, tmp_path):
    script = tmp_path / "vector.py"
    script.write_text(VECTOR.format(context=context))
    done = subprocess.run([sys.executable, script], timeout=600, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


FORKED = """
import multiprocessing
import warnings

import gymnasium as gym
import ms_highway
from jax import numpy as jnp

jnp.ones(3).sum()
warnings.simplefilter("ignore")  # JAX and Python warn of the fork


def work():
    env = gym.make("ms-highway/merger-v0", config={"controller": {"type": "fixed", "model": "naive"}})
    env.reset(seed=0)
    inner = env.unwrapped
    for compute in (lambda: env.step(0), lambda: ms_highway.plan(inner.game, inner.car_states, "naive")):
        try:
            compute()
        except RuntimeError as error:
            print(error, flush=True)


worker = multiprocessing.get_context("fork").Process(target=work)
worker.start()
worker.join()
"""


def test_a_worker_that_was_forked_after_jax_had_begun_says_so_instead_of_waiting_for_ever():
    done = subprocess.run([sys.executable, "-c", FORKED], timeout=600, capture_output=True, text=True)
    assert done.stdout.count("start it with context='forkserver' or 'spawn'") == 2


def test_stable_baselines_workers_step_the_environments():
    vectors = pytest.importorskip("stable_baselines3.common.vec_env", reason="stable-baselines3 is not installed")
    envs = vectors.SubprocVecEnv([worker] * 2)
    try:
        envs.seed(3)
        envs.reset()
        _, rewards, _, infos = envs.step(np.zeros(2, dtype=int))
    finally:
        envs.close()
    assert rewards.shape == (2,)
    assert [info["model"] for info in infos] == ["naive", "naive"]


def worker():
    return gym.make("ms_highway:ms-highway/merger-v0", config={"controller": FIXED})


@pytest.mark.parametrize("controller", [FIXED, {"type": "switching", "lambda": 0.1}])
def test_a_copy_through_pickle_goes_on_like_the_original(controller):
    env = make("merger", controller=controller)
    env.reset(seed=0)
    env.step(0)
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(8):
        (observation, reward, *_), (other, others, *_) = env.step(0), twin.step(0)
        np.testing.assert_array_equal(observation, other)
        assert reward == others


def test_measured_times_are_floats_and_no_part_of_what_makes_two_infos_equal():
    _, _, infos = drive(make("merger", controller=FIXED))
    times = pd.Series([info["timing"].planning_seconds for info in infos])
    assert times.dtype == float
    assert len(times.drop_duplicates()) > 5
    assert infos[0]["timing"] == infos[1]["timing"] == Timing(1.0, 2.0, 3.0)
