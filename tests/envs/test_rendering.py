"""Pictures and films of environments."""

import os

import episodes
import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
from commands import run
from episodes import PIXELS, make

from ms_highway import drive
from ms_highway.envs.colors import MODEL_COLORS, PALETTE
from ms_highway.envs.graphics import PANEL_LAYOUT
from ms_highway.vehicle import HumanVehicle, RobotVehicle, ScriptedVehicle
from ms_highway.visualization.video import (
    HEADING,
    film_together,
    scaled,
    side_by_side,
)


@pytest.fixture(scope="module")
def films():
    return film_together("merger", ["naive", "turn"], 1)


def pixels(frame, color):
    return int((np.abs(frame.astype(int) - color).max(axis=-1) <= 2).sum())


def rendered(controller):
    """The picture after three steps."""
    env = make("merger", controller, "rgb_array", ladder=["naive", "turn"])
    episodes.drive(env, steps=3)
    return env.render()


def test_a_frame_shows_cars_plan_and_model_in_their_colours():
    frame = rendered("turn")
    assert frame.shape == (352, 960, 3)
    for color in (RobotVehicle.COLOR, HumanVehicle.COLOR, ScriptedVehicle.COLOR):
        assert pixels(frame, color) > 500
    assert pixels(frame, MODEL_COLORS["turn"]) > 2000
    assert pixels(frame, MODEL_COLORS["tom"]) == 0


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize("driver", [None, "dummy"])
def test_pictures_are_not_black_and_change_nothing_else(driver, monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    before = dict(os.environ)
    config = {"observation": PIXELS}
    envs = [
        make("merger", render_mode="rgb_array", **config),
        gym.make("ms-highway/recorded-v0", render_mode="rgb_array"),
        drive(gym.make("highway-fast-v0", render_mode="rgb_array", config=config)),
    ]
    # highway-env's own pictures are black under a dummy driver.
    if not driver:
        envs += [gym.make("highway-fast-v0", render_mode="rgb_array", config=config)]
    for env in envs:
        observation, _ = env.reset(seed=0)
        assert env.render().std() > 10
        kind = env.unwrapped.config["observation"]["type"]
        assert kind != PIXELS["type"] or observation.std() > 10
    assert os.environ == before


@pytest.mark.parametrize(
    ("controller", "chooses"), [("turn", False), ("switching:0.1", True)]
)
def test_the_panel_gives_a_reason_only_for_chosen_models(controller, chooses):
    reason = rendered(controller)[-42:, : PANEL_LAYOUT.text_width - 60]
    assert (reason != PALETTE.paper).any() == chooses


def test_a_video_of_two_controllers_shows_both_under_their_names(films):
    halves = np.split(side_by_side(films)[39], 2)
    for film, half in zip(films, halves, strict=True):
        np.testing.assert_array_equal(half[HEADING.height :], film.pictures[39])
    naive, turn = (half[: HEADING.height] for half in halves)
    for heading, other, model in ((naive, turn, "naive"), (turn, naive, "turn")):
        assert pixels(heading, MODEL_COLORS[model]) > pixels(other, MODEL_COLORS[model])


def test_one_command_films_two_controllers_and_scales_the_video_down(films, tmp_path):
    film = tmp_path / "film.mp4"
    options = "--controller naive --against turn --seed 1 --width 480"
    run(f"video merger {options} --out {film}")
    video = imageio.imread(film, plugin="pyav")
    assert video.shape == (40, 408, 480, 3)
    road = slice(HEADING.height // 2, HEADING.height // 2 + 100)
    expected = scaled(side_by_side(films), 480)[20][road]
    assert np.abs(video[20][road] - expected.astype(int)).mean() < 4
