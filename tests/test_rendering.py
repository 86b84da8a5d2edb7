"""What a person sees."""

import gymnasium as gym
import numpy as np
import pytest

from ms_highway.envs.graphics import CONE, MODEL_COLORS, PANEL_HEIGHT, PAPER, TEXT_WIDTH
from ms_highway.experiment import make_environment
from ms_highway.vehicle import HumanVehicle, RobotVehicle, ScriptedVehicle


def pixels(frame, color):
    return int((np.abs(frame.astype(int) - color).max(axis=-1) <= 2).sum())


def filmed(scenario, controller, steps):
    env = make_environment(scenario, controller, render=True)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(0)
    return env.render()


@pytest.mark.parametrize("driver", [None, "dummy"])
def test_a_frame_shows_cars_plan_and_model_in_their_colours(driver, monkeypatch):
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    frame = filmed("merger", "turn", 3)
    assert frame.shape == (352, 960, 3)
    for color in (RobotVehicle.COLOR, HumanVehicle.COLOR, ScriptedVehicle.COLOR):
        assert pixels(frame, color) > 500
    assert pixels(frame, MODEL_COLORS["turn"]) > 2000
    assert pixels(frame, MODEL_COLORS["tom"]) == 0


def test_no_planning_time_is_charted_where_an_agent_drives():
    env = gym.make("ms-highway/merger-v0", render_mode="rgb_array", config={"action": {"type": "ContinuousAction"}})
    env.reset(seed=0)
    env.step([0.0, 0.0])
    chart = env.render()[-PANEL_HEIGHT:-90, TEXT_WIDTH:]
    assert (chart == PAPER).all()


def test_cones_stand_on_the_road_of_stay_back():
    assert pixels(filmed("stay_back", "naive", 2), CONE) > 1500


def test_closing_one_environment_leaves_the_others_drawing():
    environments = [make_environment("merger", "naive", render=True) for _ in range(2)]
    for env in environments:
        env.reset(seed=0)
        env.render()
    environments[0].close()
    environments[1].step(0)
    assert environments[1].render().std() > 10


def test_the_picture_moves_and_the_history_grows():
    env = make_environment("merger", "naive", render=True)
    env.reset(seed=0)
    first = env.render()
    for _ in range(5):
        env.step(0)
    later = env.render()
    assert (first != later).any()
    assert pixels(later, MODEL_COLORS["naive"]) > pixels(first, MODEL_COLORS["naive"])
