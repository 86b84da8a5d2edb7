"""What a person sees."""

import os

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pygame
import pytest
from episodes import make

from ms_highway import drive
from ms_highway.cli.main import main
from ms_highway.envs.graphics import MEDIUM, TEXT_WIDTH
from ms_highway.envs.viewer import ASPHALT, CONE, GROUND, INK, MODEL_COLORS, PAPER, words
from ms_highway.vehicle import HumanVehicle, RobotVehicle, ScriptedVehicle
from ms_highway.visualization.video import HEADING_HEIGHT, film_together, scaled, side_by_side, write


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
def test_pictures_are_never_black_and_leave_the_process_and_the_pictures_of_others_as_they_are(driver, monkeypatch):
    monkeypatch.delenv("SDL_VIDEODRIVER", raising=False)
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    before = dict(os.environ)
    own = [make("merger", render_mode="rgb_array", observation=PIXELS)]
    own += [gym.make(f"ms-highway/{name}-v0", render_mode="rgb_array") for name in ("demonstration", "recorded")]
    own += [drive(gym.make("highway-fast-v0", render_mode="rgb_array", config={"observation": PIXELS}))]
    others = [gym.make("highway-fast-v0", render_mode="rgb_array", config={"observation": PIXELS})]
    for env in own if driver else own + others:  # highway-env's own pictures are black under a dummy driver
        observation, _ = env.reset(seed=0)
        assert env.render().std() > 10
        assert observation.std() > 10 or env.unwrapped.config["observation"]["type"] != PIXELS["type"]
    assert os.environ == before


def test_texts_are_kerned_and_stand_on_one_line():
    apart = sum(words(letter, 26, INK).get_width() for letter in "AV")
    assert words("AV", 26, INK).get_width() < apart
    assert len({words(text, 15, INK).get_height() for text in ("x", "planning", "Ap")}) == 1


@pytest.mark.parametrize("controller", ["tom", "switching:0.1"])
def test_only_where_the_model_is_chosen_the_panel_says_why(controller):
    reason = rendered("merger", controller).render()[-42:, : TEXT_WIDTH - 60]
    assert (reason == PAPER).all() == (controller == "tom")


def test_cones_stand_on_the_road_of_stay_back():
    assert pixels(rendered("stay_back").render(), CONE) > 1500


def test_closing_one_environment_leaves_the_others_drawing():
    one, other = rendered("merger"), rendered("merger")
    one.render()
    other.render()
    one.close()
    other.step(0)
    assert other.render().std() > 10


def test_the_picture_moves_and_the_history_grows():
    env = rendered("merger", steps=0)
    first = env.render()
    for _ in range(5):
        env.step(0)
    later = env.render()
    assert (first != later).any()
    assert pixels(later, MODEL_COLORS["naive"]) > pixels(first, MODEL_COLORS["naive"])


def halves(picture):
    return np.split(picture, 2)


def test_a_video_of_two_controllers_shows_both_at_the_same_time(films):
    pictures = side_by_side(films)
    assert np.shape(pictures) == (40, 2 * (HEADING_HEIGHT + 352), 960, 3)
    for place in (0, 39):
        for film_, half in zip(films, halves(pictures[place]), strict=True):
            np.testing.assert_array_equal(half[HEADING_HEIGHT:], film_.pictures[place])
    above, below = halves(pictures[39])
    assert (above[:HEADING_HEIGHT] != below[:HEADING_HEIGHT]).any()
    assert pixels(above[:HEADING_HEIGHT], MODEL_COLORS["naive"]) > pixels(below[:HEADING_HEIGHT], MODEL_COLORS["naive"])
    assert pixels(below[:HEADING_HEIGHT], MODEL_COLORS["turn"]) > pixels(above[:HEADING_HEIGHT], MODEL_COLORS["turn"])


def test_both_films_have_one_scale_of_planning_time_in_every_picture(films):
    scale = slice(352 - 150 + 18, 352 - 150 + 35), slice(TEXT_WIDTH - 60, TEXT_WIDTH - 4)  # the number at its top
    above, below = (np.array(film_.pictures)[:, *scale] for film_ in films)
    np.testing.assert_array_equal(above, below)
    assert (above != PAPER).any()


def test_the_robots_name_stands_beside_it_in_whatever_lane_it_is():
    env = rendered("merger", steps=0)
    robot = env.unwrapped.robot
    for lane, colors in zip(env.unwrapped.game.scene.lanes, ((PAPER, ASPHALT), (INK, GROUND)), strict=True):
        name = pygame.surfarray.array3d(words("robot", MEDIUM, *colors)).swapaxes(0, 1)
        robot.position = np.array([robot.position[0], float(lane)])
        picture = env.render()
        x, y = env.unwrapped.viewer.sim_surface.vec2pix(robot.position)
        below = np.lib.stride_tricks.sliding_window_view(picture[y : y + 45, x - 40 : x + 40], name.shape)
        assert (below == name).all(axis=(-3, -2, -1)).any()


def test_the_bar_of_computing_time_grows_to_the_full_width_of_the_more_expensive_one(films):
    seconds = [sum(float(record["planning_seconds"]) for record in film_.records) for film_ in films]
    early, late = (side_by_side(films)[place] for place in (3, 39))
    widths = [
        [pixels(half[HEADING_HEIGHT - 1 : HEADING_HEIGHT], MODEL_COLORS[film_.controller]) for half, film_ in pairs]
        for pairs in (zip(halves(picture), films, strict=True) for picture in (early, late))
    ]
    assert max(widths[1]) == 960
    assert widths[1][0] / widths[1][1] == pytest.approx(seconds[0] / seconds[1], rel=0.05)
    assert 0 < widths[0][0] < widths[1][0]


def test_a_small_gif_keeps_the_colours_of_the_models(films, tmp_path):
    write(scaled(side_by_side(films), 640), tmp_path / "film.gif", 10)
    assert (tmp_path / "film.gif").stat().st_size < 400_000
    last = imageio.imread(tmp_path / "film.gif", plugin="pyav")[-1]
    assert last.shape == (544, 640, 3)
    for model in ("naive", "turn"):
        assert pixels(last, MODEL_COLORS[model], off=12) > 1000


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
