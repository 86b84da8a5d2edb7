"""The environments with several humans as Gymnasium users meet them."""

import numpy as np
import pytest
from episodes import drive, make

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


def test_an_agent_that_chooses_a_model_for_each_human_pays_for_their_time():
    env = make("dense_merge", action={"type": "HumanModelAction", "lambda": 2.0}, ladder=["naive", "tom"])
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.array([0, 1]))
    assert info["models"] == ("naive", "tom")
    assert info["rewards"]["computation"] == pytest.approx(-2 * 0.37)
    assert sum(info["rewards"].values()) == pytest.approx(reward)


@pytest.mark.parametrize("beliefs", ["learned", "true"])
def test_the_robot_assumes_the_average_reward_or_knows_every_humans_reward(beliefs):
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


@pytest.mark.filterwarnings("ignore:the values of computation")
def test_a_robot_whose_plans_exceed_the_budget_brakes_and_says_that_they_are_late():
    for scenario, shape in (("merger", (352, 960, 3)), ("dense_merge", (380, 1280, 3))):
        env = make(scenario, "budget:0.001", "rgb_array", duration=0.3)
        _, states, _, infos = drive(env)
        assert [info["status"] for info in infos] == ["late"] * 3
        assert states[1, 0, 3] < states[0, 0, 3] - 0.5
        assert env.render().shape == shape
