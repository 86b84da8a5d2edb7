"""Make videos of episodes, of one controller or of several side by side."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pygame
from jaxtyping import UInt8
from PIL import Image

from ms_highway.envs.colors import PALETTE, model_color
from ms_highway.envs.graphics import PANEL_LAYOUT
from ms_highway.envs.viewer import words
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import replacing

Picture = UInt8[np.ndarray, "h w 3"]

FORMATS = (".mp4", ".gif")
GIF_COLORS = 48  # enough for flat colours and smooth edges


@dataclass(frozen=True)
class Film:
    """A filmed episode.

    Attributes:
        controller: short name of the robot's controller.
        pictures: after each step; the last one is repeated as long as films beside this
            one go on.
        records: of each step, see `ms_highway.experiments.runner.episode`.
        frames_per_second: of true speed.
    """

    controller: str
    pictures: list[Picture]
    records: list[dict]
    frames_per_second: int


def film(scenario: str, controller: str, seed: int, **config: Any) -> Film:
    """Film an episode in a configured environment, see `film_together`."""
    return film_together(scenario, [controller], seed, **config)[0]


def film_together(
    scenario: str, controllers: Sequence[str], seed: int, **config: Any
) -> list[Film]:
    """Film an episode of each controller from the same start, with one scale of
    planning time in all pictures.

    All films are as long as the longest one: after an episode, its last picture is
    repeated.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    envs: list[Any] = [
        make_environment(scenario, name, render=True, **config) for name in controllers
    ]
    films = [
        Film(controller, [], [], env.metadata["render_fps"])
        for controller, env in zip(controllers, envs, strict=True)
    ]
    for env in envs:
        env.unwrapped.viewer = env.unwrapped.viewer_type(env.unwrapped)
    longest = 0.0
    for records in zip_longest(*(episode(env, seed) for env in envs)):
        for each, record in zip(films, records, strict=True):
            each.records.extend([record] if record else [])
        longest = max(
            longest, *(record["planning_seconds"] for record in records if record)
        )
        for each, env in zip(films, envs, strict=True):
            env.unwrapped.viewer.longest = longest
            each.pictures.append(np.asarray(env.render()))
    for env in envs:
        env.close()
    return films


def check_format(path: Path) -> None:
    """Refuse a file name of an unknown format, or of one that cannot be written here.

    Raises:
        ValueError: if the name does not end in .mp4 or .gif.
        ImportError: for an .mp4 without the packages of the extra ``video``.
    """
    if path.suffix not in FORMATS:
        raise ValueError(
            f"cannot tell the format of {path}; its name must end in"
            f" {' or '.join(FORMATS)}"
        )
    if path.suffix == ".mp4":
        _imageio()


def scaled(pictures: Sequence[Picture], width: int) -> list[Picture]:
    """Scale pictures to a width [px] in proportion; sides are even numbers, as mp4
    requires.
    """
    height, drawn = pictures[0].shape[:2]
    size = 2 * round(width / 2), 2 * round(height * width / drawn / 2)
    return [
        np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.HAMMING))
        for picture in pictures
    ]


def write(pictures: Sequence[Picture], path: Path, frames_per_second: float) -> None:
    """Write a video in the format of its file name.

    Raises:
        ValueError: if the name does not end in .mp4 or .gif.
        ImportError: for an .mp4 without the packages of the extra ``video``.
    """
    check_format(path)
    with replacing(path) as temporary:
        temporary.write_bytes(encoded(pictures, path.suffix, frames_per_second))


def encoded(
    pictures: Sequence[Picture], suffix: str, frames_per_second: float
) -> bytes:
    """Return the content of a video file, ``.mp4`` or ``.gif``.

    Raises:
        ImportError: for ``.mp4`` without the packages of the extra ``video``.
    """
    if suffix == ".gif":
        return _gif(pictures, frames_per_second)
    options = {"plugin": "pyav", "fps": frames_per_second, "codec": "libx264"}
    return _imageio().imwrite(
        "<bytes>", np.stack(pictures), extension=".mp4", **options
    )


def _imageio() -> Any:
    """Return the library that writes .mp4 files."""
    with needing("video"):
        import av  # noqa: F401
        import imageio.v3 as imageio
    return imageio


def _gif(pictures: Sequence[Picture], frames_per_second: float) -> bytes:
    """Return a GIF with one palette and no dithering, so that still parts of the
    picture take no space.
    """
    some = np.concatenate([pictures[0], pictures[len(pictures) // 2], pictures[-1]])
    palette = Image.fromarray(some).quantize(GIF_COLORS, Image.Quantize.FASTOCTREE)
    images = [
        Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE)
        for each in pictures
    ]
    content, duration = io.BytesIO(), 1000 / frames_per_second  # ms
    images[0].save(
        content,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=duration,
        loop=0,
        optimize=True,
    )
    return content.getvalue()


HEADING_HEIGHT = 56  # px
BAR_HEIGHT = 10  # px
NAME_SIZE, NUMBERS_SIZE = 26, 20  # px, of texts


def side_by_side(films: Sequence[Film]) -> list[Picture]:
    """Put films of one scenario and of the same length one above the other, as roads
    are wide and low.

    The heading of each shows its controller, its mean reward per step and its time of
    planning and deciding so far; a bar shows this time, coloured by model, in one scale
    for all films.
    """
    longest = max(sum(map(_seconds, film.records)) for film in films)
    return [
        np.concatenate(
            [part for film in films for part in _titled(film, place, longest)]
        )
        for place in range(len(films[0].pictures))
    ]


def _seconds(record: Mapping) -> float:
    """Return the time of planning and deciding in a step [s]."""
    return float(record["planning_seconds"] + record["decision_seconds"])


def _titled(film: Film, place: int, longest: float) -> tuple[Picture, Picture]:
    """Return the heading and the picture of a film at a place; ``longest`` [s] is the
    full length of the bar.
    """
    picture = film.pictures[place]
    records = film.records[: place + 1]
    width = picture.shape[1]
    middle = (HEADING_HEIGHT - BAR_HEIGHT) // 2
    surface = pygame.Surface((width, HEADING_HEIGHT))
    end = 0.0
    surface.fill(PALETTE.ink)
    for record in records:
        start = end
        end = end + _seconds(record) / longest * width
        bar = (
            round(start),
            HEADING_HEIGHT - BAR_HEIGHT,
            round(end) - round(start),
            BAR_HEIGHT,
        )
        surface.fill(model_color(record["model"]), bar)
    name = words(film.controller, NAME_SIZE, PALETTE.paper)
    surface.blit(name, name.get_rect(midleft=(PANEL_LAYOUT.margin, middle)))
    reward = np.mean([record["reward"] for record in records])
    taken = sum(map(_seconds, records))
    numbers = words(
        f"reward per step {reward:+.2f}      computing {1e3 * taken:.1f} ms",
        NUMBERS_SIZE,
        PALETTE.paper,
    )
    surface.blit(
        numbers, numbers.get_rect(midright=(width - PANEL_LAYOUT.margin, middle))
    )
    return pygame.surfarray.array3d(surface).swapaxes(0, 1), picture
