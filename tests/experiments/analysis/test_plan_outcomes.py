"""What plans count on and what comes of them."""

import io

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console

from ms_highway.control.fixed import FixedModel
from ms_highway.experiments.analysis.plan_outcomes import follow_plan
from ms_highway.planning.human_models import ladder
from ms_highway.vehicle import RobotVehicle
from ms_highway.visualization.plan_outcomes import plan_outcome_figure, plan_outcome_table

MODELS = ladder(["naive", "turn"])
HARD = 50.0  # m/s^2, end of the actions' range
ACTION = {"type": "ContinuousAction", "acceleration_range": [-HARD, HARD], "steering_range": [-1.0, 1.0]}


def situation(identity="ms-highway/merger-v0", steps=3):
    env = gym.make(identity, config={"controller": {"type": "fixed", "model": "turn"}}).unwrapped
    env.reset(seed=3)
    for _ in range(steps):
        env.step(0)
    return env


@pytest.mark.parametrize(
    "identity", ["ms-highway/merger-v0", pytest.param("ms-highway/give-way-v0", marks=pytest.mark.slow)]
)
def test_what_comes_of_a_plan_is_what_comes_of_it_in_the_environment(identity):
    """An agent that executes the plan meets the same human and earns the same."""
    before = situation(identity)
    for model, one in zip(MODELS, follow_plan(before.game, MODELS, before.car_states), strict=True):
        plan = FixedModel(before.game, model).step(before.car_states).plan
        env = gym.make(identity, config={"action": ACTION}).unwrapped
        env.reset(options={"initial_states": before.car_states})
        for (omega, acceleration), states, reward in zip(plan, one.actual[1:], one.actual_reward, strict=True):
            _, earned, *_ = env.step(np.array([acceleration / HARD, np.arctan(omega * RobotVehicle.LENGTH)]))
            np.testing.assert_allclose(env.car_states, states, atol=1e-3)
            assert earned == pytest.approx(reward, abs=1e-2)


def test_the_human_is_expected_as_the_model_says_and_does_something_else():
    env = situation()
    naive, turn = follow_plan(env.game, MODELS, env.car_states)
    assert naive.expected_acceleration == pytest.approx(0, abs=1e-6)
    assert turn.expected_acceleration < -1  # it yields
    for one in (naive, turn):
        np.testing.assert_allclose(one.expected[:, 0], one.actual[:, 0])  # the robot does what it planned
        assert one.actual_acceleration < one.expected_acceleration - 1
        assert one.error == pytest.approx(np.hypot(*(one.expected - one.actual)[-1, 1, :2]))
    assert naive.error > turn.error > 0.05


def test_in_released_semantics_plans_do_not_count_on_the_drag_of_the_world():
    env = gym.make("ms-highway/merger-v0", config={"semantics": "released"}).unwrapped
    env.reset(seed=0)
    (naive,) = follow_plan(env.game, MODELS[:1], env.car_states)
    assert naive.actual[-1, 0, 3] < naive.expected[-1, 0, 3]


def test_the_figure_shows_every_model_in_a_picture_that_moves_with_the_human(tmp_path):
    env = situation()
    foresights = follow_plan(env.game, MODELS, env.car_states)
    figure = plan_outcome_figure(foresights, env.game.scene)
    for axes, one in zip(figure.axes, foresights, strict=True):
        assert axes.get_title("left").startswith(one.model)
        robot, actual, expected = (line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 6)
        np.testing.assert_allclose(robot[:, 1], one.actual[:, 0, 1])
        np.testing.assert_allclose(actual[0], [0, one.actual[0, 1, 1]])
        if one.model == "naive":
            assert abs(expected[:, 0]).max() < 0.05  # who keeps the velocity stands still
            assert actual[-1, 0] < -0.3  # who brakes falls back
    figure.savefig(tmp_path / "foresight.png")
    assert imread(tmp_path / "foresight.png").std() > 0.01


def test_the_table_tells_what_each_plan_counts_on():
    env = situation()
    foresights = follow_plan(env.game, MODELS, env.car_states)
    console = Console(file=io.StringIO(), width=200)
    console.print(plan_outcome_table(foresights))
    rows = [line.split() for line in console.file.getvalue().splitlines() if line.split()[:1] in (["naive"], ["turn"])]
    for row, one in zip(rows, foresights, strict=True):
        assert row[2:5] == [
            f"{abs(x):.2f}" if abs(x) < 0.005 else f"{x:.2f}"
            for x in (one.expected_acceleration, one.actual_acceleration, one.error)
        ]


def test_an_impossible_situation_is_refused():
    env = situation(steps=0)
    states = env.car_states
    states[1, 3] = np.nan
    with pytest.raises(ValueError, match="the state of car 1 is not finite: speed is nan"):
        follow_plan(env.game, MODELS, states)
