"""Pictures and films of environments."""

import os

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest
from episodes import make

from ms_highway import drive
from ms_highway.cli.main import main
from ms_highway.envs.graphics import TEXT_WIDTH
from ms_highway.envs.viewer import MODEL_COLORS, PAPER
from ms_highway.vehicle import HumanVehicle, RobotVehicle, ScriptedVehicle
from ms_highway.visualization.video import HEADING_HEIGHT, film_together, scaled, side_by_side


@pytest.fixture(scope="module")
def films():
    return film_together("merger", ["naive", "turn"], 1)


def pixels(frame, color, off=2):
    return int((np.abs(frame.astype(int) - color).max(axis=-1) <= off).sum())


def rendered(scenario, controller="naive", steps=2, **config):
    """The environment after some steps."""
    env = make(scenario, controller, "rgb_array", **config)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(env.action_space.sample())
    return env


@pytest.mark.parametrize("driver", [None, "dummy"])
def test_a_frame_shows_cars_plan_and_model_in_their_colours(driver, monkeypatch):
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    frame = rendered("merger", "turn", 3).render()
    assert frame.shape == (352, 960, 3)
    for color in (RobotVehicle.COLOR, HumanVehicle.COLOR, ScriptedVehicle.COLOR):
        assert pixels(frame, color) > 500
    assert pixels(frame, MODEL_COLORS["turn"]) > 2000
    assert pixels(frame, MODEL_COLORS["tom"]) == 0


PIXELS = {"type": "GrayscaleObservation", "observation_shape": (64, 64), "stack_size": 1, "weights": [0.3, 0.6, 0.1]}


@pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")
@pytest.mark.parametrize("driver", [None, "dummy"])
def test_pictures_are_not_black_and_change_neither_the_process_nor_pictures_of_others(driver, monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    before = dict(os.environ)
    own = [make("merger", render_mode="rgb_array", observation=PIXELS)]
    own += [gym.make(f"ms-highway/{name}-v0", render_mode="rgb_array") for name in ("demonstration", "recorded")]
    own += [drive(gym.make("highway-fast-v0", render_mode="rgb_array", config={"observation": PIXELS}))]
    others = [gym.make("highway-fast-v0", render_mode="rgb_array", config={"observation": PIXELS})]
    for env in own if driver else own + others:  # highway-env's pictures are black under a dummy driver
        observation, _ = env.reset(seed=0)
        assert env.render().std() > 10
        assert observation.std() > 10 or env.unwrapped.config["observation"]["type"] != PIXELS["type"]
    assert os.environ == before


@pytest.mark.parametrize("controller", ["tom", "switching:0.1"])
def test_the_panel_gives_a_reason_only_if_the_model_is_chosen(controller):
    reason = rendered("merger", controller).render()[-42:, : TEXT_WIDTH - 60]
    assert (reason == PAPER).all() == (controller == "tom")


def test_a_video_of_two_controllers_shows_both_under_their_names(films):
    pictures = side_by_side(films)
    assert np.shape(pictures) == (40, 2 * (HEADING_HEIGHT + 352), 960, 3)
    for place in (0, 39):
        for film_, half in zip(films, np.split(pictures[place], 2), strict=True):
            np.testing.assert_array_equal(half[HEADING_HEIGHT:], film_.pictures[place])
    naive, turn = (half[:HEADING_HEIGHT] for half in np.split(pictures[39], 2))
    for heading, other, model in ((naive, turn, "naive"), (turn, naive, "turn")):
        assert pixels(heading, MODEL_COLORS[model]) > pixels(other, MODEL_COLORS[model])


def test_one_command_films_two_controllers_and_scales_the_video_down(films, tmp_path, monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    out = tmp_path / "film.mp4"
    arguments = ["video", "merger", "--controller", "naive", "--against", "turn", "--seed", "1", "--width", "480"]
    assert main([*arguments, "--out", str(out)]) == 0
    assert "SDL_VIDEODRIVER" not in os.environ
    video = imageio.imread(out, plugin="pyav")
    assert video.shape == (40, 408, 480, 3)
    expected = scaled(side_by_side(films), 480)[20]
    road = slice(HEADING_HEIGHT // 2, HEADING_HEIGHT // 2 + 100)
    assert np.abs(video[20][road].astype(int) - expected[road]).mean() < 4
