"""Videos of one controller, and of two from the same start."""

from dataclasses import replace

import imageio.v3 as imageio
import numpy as np
import pytest

from ms_highway.cli import main
from ms_highway.compiled import low_latency
from ms_highway.envs.graphics import MODEL_COLORS
from ms_highway.side_by_side import HEADING_HEIGHT, side_by_side
from ms_highway.video import film, scaled, write

ROAD = slice(HEADING_HEIGHT, HEADING_HEIGHT + 200)  # rows of a film's part of the picture that show no measured time


@pytest.fixture(scope="module")
def films():
    low_latency()  # as the command does, so that it finds here what is compiled
    return [film("stay_back", controller, 1) for controller in ("naive", "turn")]


def shows(picture, color):
    return int((np.abs(picture.astype(int) - color).max(axis=-1) <= 12).sum())


def halves(picture):
    return np.split(picture, 2)


def test_a_video_of_two_controllers_shows_both_at_the_same_time(films):
    pictures = side_by_side(films)
    assert np.shape(pictures) == (35, 2 * (HEADING_HEIGHT + 352), 960, 3)
    for place in (0, 34):
        for film_, half in zip(films, halves(pictures[place]), strict=True):
            np.testing.assert_array_equal(half[HEADING_HEIGHT:], film_.pictures[place])
    above, below = halves(pictures[34])
    assert (above[:HEADING_HEIGHT] != below[:HEADING_HEIGHT]).any()
    assert shows(above[:HEADING_HEIGHT], MODEL_COLORS["naive"]) > shows(below[:HEADING_HEIGHT], MODEL_COLORS["naive"])
    assert shows(below[:HEADING_HEIGHT], MODEL_COLORS["turn"]) > shows(above[:HEADING_HEIGHT], MODEL_COLORS["turn"])


def test_the_same_controller_from_the_same_start_drives_the_same(films):
    above, below = halves(side_by_side([films[0], film("stay_back", "naive", 1)])[-1])
    np.testing.assert_array_equal(above[ROAD], below[ROAD])


def test_the_bar_of_computing_time_grows_to_the_full_width_of_the_dearer_one(films):
    seconds = [sum(float(record["planning_seconds"]) for record in film_.records) for film_ in films]
    early, late = (side_by_side(films)[place] for place in (3, 34))
    widths = [
        [shows(half[HEADING_HEIGHT - 1 : HEADING_HEIGHT], MODEL_COLORS[film_.controller]) for half, film_ in pairs]
        for pairs in (zip(halves(picture), films, strict=True) for picture in (early, late))
    ]
    assert max(widths[1]) == 960
    assert widths[1][0] / widths[1][1] == pytest.approx(seconds[0] / seconds[1], rel=0.05)
    assert 0 < widths[0][0] < widths[1][0]


def test_the_shorter_of_two_films_holds_its_last_picture(films):
    short = replace(films[0], pictures=films[0].pictures[:10], records=films[0].records[:10])
    pictures = side_by_side([short, films[1]])
    assert len(pictures) == 35
    above, _ = halves(pictures[34])
    np.testing.assert_array_equal(above[HEADING_HEIGHT:], films[0].pictures[9])


def test_films_of_several_sizes_are_not_shown_together(films):
    small = replace(films[0], pictures=scaled(films[0].pictures, 480))
    with pytest.raises(ValueError, match="several sizes"):
        side_by_side([small, films[1]])


def test_a_small_gif_keeps_the_colours_of_the_models(films, tmp_path):
    write(scaled(side_by_side(films), 640), tmp_path / "film.gif", 10)
    assert (tmp_path / "film.gif").stat().st_size < 400_000
    last = imageio.imread(tmp_path / "film.gif", plugin="pyav")[-1]
    assert last.shape == (544, 640, 3)
    for model in ("naive", "turn"):
        assert shows(last, MODEL_COLORS[model]) > 1000


def test_one_command_films_two_controllers_and_scales_the_video_down(films, tmp_path):
    out = tmp_path / "film.mp4"
    arguments = ["video", "stay_back", "--controller", "naive", "--against", "turn", "--seed", "1", "--width", "480"]
    assert main([*arguments, "--out", str(out)]) == 0
    video = imageio.imread(out, plugin="pyav")
    assert video.shape == (35, 408, 480, 3)
    expected = scaled(side_by_side(films), 480)[20]
    road = slice(HEADING_HEIGHT // 2, HEADING_HEIGHT // 2 + 100)
    assert np.abs(video[20][road].astype(int) - expected[road]).mean() < 4
