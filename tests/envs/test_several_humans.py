"""The environments with several humans, as a Gymnasium user meets them."""

import numpy as np
import pytest
from episodes import drive, make

from ms_highway.envs.registry import controller_settings
from ms_highway.envs.viewer import model_color

AGENT = {"type": "ContinuousAction"}
STRAIGHT = np.zeros(2, np.float32)


@pytest.mark.slow
def test_a_robot_under_theory_of_mind_merges_into_the_stream_before_the_cones():
    _, states, _, infos = drive(make("dense_merge", "tom"))
    assert len(infos) == 80
    assert infos[-1]["success"]
    assert not infos[0]["success"]
    assert abs(states[-1, 0, 1] - states[-1, 1:, 1].mean()) < 0.8
    assert not any(info["collision"] for info in infos)
    for info in infos:
        assert info["models"] == ("tom", "tom")
        assert (info["humans_turn"], info["humans_tom"], info["model"]) == (0, 2, "tom")
        assert info["human_status"] == ("planned", "planned")
        assert info["counted_seconds"] == pytest.approx(0.09 + 2 * (0.37 - 0.09))


def test_the_same_seed_gives_the_same_humans_and_another_one_others():
    env = make("dense_merge").unwrapped
    drawn = []
    for seed in (7, 7, 8):
        env.reset(seed=seed)
        drawn.append((env.car_states, env.weights))
    first, again, other = drawn
    for same, there, elsewhere in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(same, there)
        assert abs(same - elsewhere).max() > 0


def test_random_models_are_drawn_for_each_of_the_humans():
    models = controller_settings("random:naive=0.5,tom=0.5").table(80, 2, np.random.default_rng(0))
    assert {*map(tuple, models)} == {("naive", "naive"), ("naive", "tom"), ("tom", "naive"), ("tom", "tom")}


def test_the_agent_that_chooses_a_model_for_each_human_pays_for_their_time():
    env = make("dense_merge", action={"type": "HumanModelAction", "lambda": 2.0}, ladder=["naive", "tom"])
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.array([0, 1]))
    assert info["models"] == ("naive", "tom")
    assert info["rewards"]["computation"] == pytest.approx(-2 * 0.37)
    assert sum(info["rewards"].values()) == pytest.approx(reward)
    with pytest.raises(ValueError, match="is no place in the ladder"):
        env.unwrapped.step(1)


def test_an_agent_whose_plans_are_late_pays_for_what_it_chose_and_sees_what_is_followed():
    agent = {"type": "HumanModelAction", "lambda": 2.0}
    env = make("dense_merge", "budget:0.001", action=agent, ladder=["naive", "tom"])
    env.reset(seed=0)
    infos = [env.step(np.array(choice))[-1] for choice in ([0, 1], [1, 0], [0, 0])]
    assert [info["status"] for info in infos] == ["late"] * 3
    assert [info["models"] for info in infos[1:]] == [("naive", "tom"), ("tom", "naive")]
    paid = [info["rewards"]["computation"] for info in infos]
    np.testing.assert_allclose(paid, [-2 * 0.37, -2 * 0.37, -2 * 0.09])


@pytest.mark.parametrize("beliefs", ["learned", "true"])
def test_the_robot_believes_in_the_average_driver_or_knows_everybodys_reward(beliefs):
    inner = make("dense_merge", beliefs=beliefs).unwrapped
    average, believed = inner.game.humans.weights, inner.robot.controller.game.humans.weights
    np.testing.assert_array_equal(believed, average if beliefs == "learned" else inner.weights)
    assert abs(inner.weights - average).max() > 0


def test_after_a_collision_there_is_no_success():
    env = make("dense_merge", action=AGENT, duration=0.3)
    lane = float(env.unwrapped.game.scene.target_lane)
    starts = [[0, lane, 0, 20], [2, lane, 0, 20], [-30, lane, 0, 20]]
    *_, infos = drive(env, starts=starts, action=STRAIGHT)
    assert infos[0]["collision"]
    assert not any(info["success"] for info in infos)
    starts[1][0] = 30
    *_, infos = drive(env, starts=starts, action=STRAIGHT)
    assert all(info["success"] for info in infos)


def test_the_distance_to_the_cones_is_that_from_the_robots_front_in_its_lane():
    env = make("dense_merge", action=AGENT)
    starts = np.array([[0.0, 0, 0, 20], [30, -3.3, 0, 20], [-30, -3.3, 0, 20]])
    _, info = env.reset(options={"initial_states": starts})
    first = env.unwrapped.road.objects[0]
    assert info["distance_to_cones"] == pytest.approx(first.position[0] - first.LENGTH / 2 - 2.5)
    starts[0, 1] = -3.3
    _, info = env.reset(options={"initial_states": starts})
    assert info["distance_to_cones"] == np.inf


def test_starts_of_another_number_of_humans_belong_to_the_configuration_that_comes_with_them():
    env = make("dense_merge", humans=3)
    starts = env.unwrapped.draw_episode(np.random.default_rng(0))[0][:3]
    env.reset(options={"config": {"humans": 2}, "initial_states": starts})
    np.testing.assert_allclose(env.unwrapped.car_states, starts)
    with pytest.raises(ValueError, match=r"dense_merge needs an array \(4, 4\)"):
        env.reset(options={"config": {"humans": 3}, "initial_states": starts})


def test_a_robot_that_is_too_late_for_its_budget_drives_on_with_what_it_has_and_says_so():
    for scenario, shape in (("merger", (352, 960, 3)), ("dense_merge", (380, 1280, 3))):
        env = make(scenario, "budget:0.001", "rgb_array", duration=0.3)
        _, states, _, infos = drive(env)
        assert [info["status"] for info in infos] == ["late"] * 3
        assert states[1, 0, 3] < states[0, 0, 3] - 0.5
        assert env.render().shape == shape


def test_humans_have_the_colours_of_the_models_that_predict_them():
    env = make("dense_merge", "tom", "rgb_array", duration=0.3)
    drive(env)
    picture, surface = env.render(), env.unwrapped.viewer.sim_surface
    for human in env.unwrapped.humans:
        x, y = surface.vec2pix(human.position + np.array([-1.2, 0.6]))
        np.testing.assert_array_equal(picture[int(y), int(x)], model_color("tom"))
