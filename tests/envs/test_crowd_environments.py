"""The environments with several humans, as a Gymnasium user meets them."""

import warnings
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ms_highway.envs import CROWD_SCENARIOS, ENVIRONMENTS, SCENARIOS, environment_id, two_player_scenario
from ms_highway.envs.crowd.base import CrowdEnv
from ms_highway.envs.graphics import model_color
from ms_highway.experiments.analysis.summary import summary
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.results import read_results
from ms_highway.experiments.runner import STEPS_FILE, read, run
from ms_highway.planning.compiled_crowd import CompiledCrowdPlans
from ms_highway.visualization.video import film

FIXED = {"type": "fixed", "model": "tom"}
AGENT = {"type": "ContinuousAction"}


def make(scenario="dense_merge", render_mode=None, **config):
    config = {"humans": 2, "controller": FIXED, "costs": "published"} | config
    return gym.make(environment_id(scenario), render_mode=render_mode, config=config)


def keep_straight():
    return np.zeros(2, np.float32)


def drive(env, seed=0, options=None, act=int):
    """The states before the first and after every step, and the infos of a whole episode."""
    env.reset(seed=seed, options=options)
    states, infos, done = [env.unwrapped.car_states], [], False
    while not done:
        *_, terminated, truncated, info = env.step(act())
        done = terminated or truncated
        states.append(env.unwrapped.car_states)
        infos.append(info)
    return np.array(states), infos


@pytest.mark.parametrize(("scenario", "action"), [("dense_merge", {"type": "Autopilot"}), ("crossing_crowd", AGENT)])
def test_gymnasiums_checker_passes_without_a_warning(scenario, action):
    env = make(scenario, "rgb_array", action=action, duration=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_the_scenarios_are_known_beside_those_with_one_human():
    assert [name for name in ENVIRONMENTS if issubclass(ENVIRONMENTS[name], CrowdEnv)] == list(CROWD_SCENARIOS)
    assert not set(CROWD_SCENARIOS) & set(SCENARIOS)
    assert all(environment_id(name).removeprefix("ms_highway:") in gym.registry for name in CROWD_SCENARIOS)
    with pytest.raises(ValueError, match="dense_merge has several humans; the scenarios with one human are stay_back"):
        two_player_scenario("dense_merge")


def test_a_robot_under_theory_of_mind_merges_into_the_stream_before_the_cones():
    states, infos = drive(make())
    assert len(infos) == 80
    assert infos[-1]["success"]
    assert not infos[0]["success"]
    target = states[-1, 1:, 1].mean()
    assert abs(states[-1, 0, 1] - target) < 0.8
    assert not any(info["collision"] for info in infos)
    for info in infos:
        assert info["rungs"] == ("tom", "tom")
        assert (info["humans_turn"], info["humans_tom"], info["model"]) == (0, 2, "tom")
        assert info["human_status"] == ("planned", "planned")
        assert info["counted_seconds"] == pytest.approx(0.09 + 2 * (0.37 - 0.09))


def test_the_same_seed_gives_the_same_episode_and_another_one_other_humans():
    env = make(duration=0.5)
    first, again, weights = drive(env, 7)[0], drive(env, 7)[0], env.unwrapped.weights
    np.testing.assert_array_equal(first, again)
    other = drive(env, 8)[0]
    assert abs(first - other).max() > 0.1
    assert abs(weights - env.unwrapped.weights).max() > 0


def test_every_human_drives_for_its_own_reward_and_believes_that_all_others_keep_their_velocity():
    env = make(action=AGENT)
    env.reset(seed=3)
    inner = env.unwrapped
    plans = CompiledCrowdPlans(inner.settings.crowd(inner.scenario, inner.weights))
    before = inner.car_states.astype(np.float32)
    env.step(keep_straight())
    scale = np.asarray(inner.game.planner.control_scale)
    for number, human in enumerate(inner.road.vehicles[1:]):
        expected = plans.predict(before, number)[0][0] * scale
        np.testing.assert_allclose(human.last_step.control, expected, atol=2e-3)


@pytest.mark.parametrize("beliefs", ["learned", "true"])
def test_the_robot_believes_in_the_average_driver_or_knows_everybodys_reward(beliefs):
    env = make(beliefs=beliefs)
    env.reset(seed=1)
    inner = env.unwrapped
    average = np.tile(inner.game.human.weights, (2, 1))
    believed = inner.robot.controller.crowd.weights
    np.testing.assert_array_equal(believed, average if beliefs == "learned" else inner.weights)
    assert abs(inner.weights - average).max() > 0


def test_after_a_collision_there_is_no_success():
    env = make(action=AGENT, duration=0.3)
    lane = float(env.unwrapped.game.scene.target_lane)
    starts = [[0, lane, 0, 20], [2, lane, 0, 20], [-30, lane, 0, 20]]
    _, infos = drive(env, options={"initial_states": starts}, act=keep_straight)
    assert infos[0]["collision"]
    assert not any(info["success"] for info in infos)
    starts[1][0] = 30
    _, infos = drive(env, options={"initial_states": starts}, act=keep_straight)
    assert all(info["success"] for info in infos)


def test_the_distance_to_the_cones_is_that_from_the_robots_front_in_its_lane():
    env = make(action=AGENT)
    inner = env.unwrapped
    starts = np.array([[0.0, 0, 0, 20], [30, -3.3, 0, 20], [-30, -3.3, 0, 20]])
    _, info = env.reset(options={"initial_states": starts})
    first = inner.road.objects[0]
    assert info["distance_to_cones"] == pytest.approx(first.position[0] - first.LENGTH / 2 - 2.5)
    starts[0, 1] = -3.3
    _, info = env.reset(options={"initial_states": starts})
    assert info["distance_to_cones"] == np.inf


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"humans": 1}, r"config\['humans'\] is 1; it must be a whole number from 2 to 12"),
        ({"humans": 13}, r"config\['humans'\] is 13; it must be a whole number from 2 to 12"),
        ({"humans": 2.5}, r"config\['humans'\] is 2.5; it must be a whole number from 2 to 12"),
        ({"human": 3}, r"unknown key 'human' in config; did you mean 'humans'\?"),
        ({"ladder": ["naive"]}, "unknown key 'ladder' in config"),
        ({"beliefs": "none"}, r"config\['beliefs'\] is 'none'; choose one of 'learned', 'true'"),
        ({"semantics": "released"}, r"config\['semantics'\] is 'released'; choose one of 'paper'"),
        ({"solver": "newton"}, r"config\['solver'\] is 'newton'; choose one of 'damped_newton', 'gradient'"),
        ({"action": {"type": "HumanModelAction", "lambda": 1}}, "which is for one human; say 'Autopilot'"),
        ({"controller": {"type": "horizon", "lambda": 1}}, r"config\['controller'\] is .*horizon"),
        ({"costs": {"naive": 0.1}}, "no seconds for 'turn'"),
    ],
)
def test_impossible_configurations_are_refused_with_value_place_and_remedy(config, message):
    with pytest.raises(ValueError, match=message):
        make(**config)


def test_humans_have_the_colours_of_the_models_that_predict_them():
    env = make(render_mode="rgb_array", duration=0.3)
    drive(env)
    picture, surface = env.render(), env.unwrapped.viewer.sim_surface
    for human in env.unwrapped.road.vehicles[1:]:
        x, y = surface.vec2pix(human.position + np.array([-1.2, 0.6]))
        np.testing.assert_array_equal(picture[int(y), int(x)], model_color("tom"))


def test_a_film_shows_every_step_of_an_episode():
    shot = film("dense_merge", "naive", 0, humans=2, costs="published", duration=0.3)
    assert shot.frames_per_second == 10
    assert [picture.shape for picture in shot.pictures] == [(420, 1280, 3)] * 3
    assert all((one != other).any() for one, other in pairwise(shot.pictures))


def test_a_robot_that_is_too_late_for_its_budget_drives_on_with_what_it_has_and_says_so():
    env = make(render_mode="rgb_array", duration=0.3, controller={"type": "budget", "milliseconds": 1e-3})
    states, infos = drive(env)
    assert env.unwrapped.budget == pytest.approx(1e-6)
    assert [info["status"] for info in infos] == ["late"] * 3
    assert states[1, 0, 3] < states[0, 0, 3] - 0.5
    assert env.render().shape == (420, 1280, 3)


def test_a_comparison_counts_successes_and_the_humans_under_each_model(tmp_path):
    comparison = Comparison({"dense_merge": ["naive", "tom"]}, seeds=1, costs="published", planning={"humans": 2})
    comparison.check()
    assert comparison.solver == "damped_newton"
    assert list(run(comparison, tmp_path)) == [0, 1, 2]
    assert list(run(comparison, tmp_path)) == [2]
    records = read(comparison, tmp_path)
    assert records.groupby("controller")[["humans_turn", "humans_tom"]].max().to_dict() == {
        "humans_turn": {"naive": 0, "tom": 0},
        "humans_tom": {"naive": 0, "tom": 2},
    }
    last = records[records["step"] == 79].set_index("controller")["success"].astype(float)
    table = summary(records).set_index("controller")
    assert table["success"].to_dict() == last.to_dict()
    assert table.loc["tom", "success"] == 1.0
    results = read_results(tmp_path)
    assert results.config("dense_merge")["solver"] == "damped_newton"
    assert (tmp_path / STEPS_FILE).read_text().startswith("scenario,")


def test_scenarios_with_one_human_and_with_several_are_compared_apart():
    with pytest.raises(ValueError, match="dense_merge has several humans, the other scenarios one; compare them in"):
        Comparison({"merger": ["naive"], "dense_merge": ["naive"]}).check()
    assert Comparison({"merger": ["naive"]}).solver == "gradient"
    assert Comparison({"merger": ["naive"]}).costs == "published"
    assert Comparison({"dense_merge": ["naive"]}).costs == "measured"


def test_starts_of_another_number_of_humans_belong_to_the_configuration_that_comes_with_them():
    env = gym.make("ms-highway/dense-merge-v0", config={"humans": 3, "controller": {"type": "fixed", "model": "naive"}})
    starts = env.unwrapped.draw_starts(np.random.default_rng(0))[:3]
    env.reset(options={"config": {"humans": 2}, "initial_states": starts})
    np.testing.assert_allclose(env.unwrapped.car_states, starts)
    with pytest.raises(ValueError, match="initial_states"):
        env.reset(options={"config": {"humans": 3}, "initial_states": starts})


def test_a_picture_is_drawn_where_the_agent_drives():
    config = {"humans": 2, "action": {"type": "ContinuousAction"}}
    env = gym.make("ms-highway/dense-merge-v0", render_mode="rgb_array", config=config)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.render().std() > 0
