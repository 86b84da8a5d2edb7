"""The environments with several humans as Gymnasium users meet them."""

import numpy as np
import pytest
from episodes import drive, make


@pytest.mark.slow
def test_a_robot_under_theory_of_mind_merges_into_the_stream_before_the_cones():
    _, states, _, infos = drive(make("dense_merge", "tom"))
    assert infos[-1]["success"]
    assert not infos[0]["success"]
    assert abs(states[-1, 0, 1] - states[-1, 1:, 1].mean()) < 0.8
    assert not any(info["collision"] for info in infos)
    for info in infos:
        assert info["models"] == ("tom", "tom")
        assert (info["humans_turn"], info["humans_tom"], info["model"]) == (0, 2, "tom")
        assert info["counted_seconds"] == pytest.approx(0.09 + 2 * (0.37 - 0.09))


def test_an_agent_that_chooses_a_model_for_each_human_pays_for_their_time():
    env = make("dense_merge", action={"type": "HumanModelAction", "lambda": 2.0}, ladder=["naive", "turn"])
    env.reset(seed=0)
    _, reward, *_, info = env.step(np.array([0, 1]))
    assert info["models"] == ("naive", "turn")
    assert info["rewards"]["computation"] == pytest.approx(-2 * 0.17)
    assert sum(info["rewards"].values()) == pytest.approx(reward)


@pytest.mark.parametrize("beliefs", ["learned", "true"])
def test_the_robot_assumes_the_average_reward_or_knows_every_humans_reward(beliefs):
    inner = make("dense_merge", beliefs=beliefs).unwrapped
    average, believed = inner.game.humans.weights, inner.robot.controller.game.humans.weights
    np.testing.assert_array_equal(believed, average if beliefs == "learned" else inner.weights)
    assert abs(inner.weights - average).max() > 0


@pytest.mark.filterwarnings("ignore:the values of computation")
def test_a_robot_whose_plans_exceed_the_budget_brakes_and_says_that_they_are_late():
    env = make("dense_merge", "budget:0.001", "rgb_array", ladder=["naive"], duration=0.3)
    _, states, _, infos = drive(env)
    assert [info["status"] for info in infos] == ["late"] * 3
    assert states[1, 0, 3] < states[0, 0, 3] - 0.5
    assert env.render().shape == (380, 1280, 3)
