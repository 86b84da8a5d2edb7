"""The environments with several humans as Gymnasium users meet them."""

import numpy as np
import pytest
from episodes import drive, make


def test_an_agent_pays_for_each_humans_model():
    names = ["naive", "turn"]
    action = {"type": "HumanModelAction", "lambda": 2.0}
    env = make("dense_merge", action=action, ladder=names)
    env.reset(seed=0)
    for rungs, seconds in (([0, 1], 0.17), ([1, 1], 0.09 + 2 * (0.17 - 0.09))):
        _, reward, *_, info = env.step(np.array(rungs))
        assert info["models"] == tuple(names[rung] for rung in rungs)
        assert info["humans_turn"] == sum(rungs)
        assert info["model"] == "turn"
        assert not info["success"]
        assert info["counted_seconds"] == pytest.approx(seconds)
        assert info["rewards"]["computation"] == pytest.approx(-2 * seconds)
        assert sum(info["rewards"].values()) == pytest.approx(reward)


def test_the_robot_assumes_the_average_reward_of_humans_who_differ():
    inner = make("dense_merge").unwrapped
    average = inner.game.humans.weights
    believed = inner.robot.controller.game.humans.weights
    np.testing.assert_array_equal(believed, average)
    assert abs(inner.weights - average).max() > 0


@pytest.mark.filterwarnings("ignore:the values of computation")
def test_a_robot_with_late_plans_brakes_and_says_so():
    env = make(
        "dense_merge", "budget:0.001", "rgb_array", ladder=["naive"], duration=0.3
    )
    _, states, _, infos = drive(env)
    assert [info["status"] for info in infos] == ["late"] * 3
    assert states[1, 0, 3] < states[0, 0, 3] - 0.5
    assert env.render().shape == (380, 1280, 3)
