"""Make videos of episodes, of one controller or of several side by side."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from types import ModuleType

import numpy as np
import pygame
from jaxtyping import UInt8
from PIL import Image

from ms_highway.envs.colors import PALETTE, model_color
from ms_highway.envs.graphics import PANEL_LAYOUT
from ms_highway.envs.viewer import words
from ms_highway.experiments.runner import episode, interaction, make_environment
from ms_highway.runtime.extras import needing
from ms_highway.runtime.files import replacing

Picture = UInt8[np.ndarray, "h w 3"]


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


def film(scenario: str, controller: str, seed: int, **config: object) -> Film:
    """Film an episode in a configured environment, see `film_together`."""
    return film_together(scenario, [controller], seed, **config)[0]


def film_together(
    scenario: str,
    controllers: Sequence[str],
    seed: int,
    **config: object,
) -> list[Film]:
    """Film an episode of each controller from the same start.

    All pictures have one scale of planning time. All films are as long as the longest
    one: after an episode, its last picture is repeated.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    envs = []
    viewers = []
    films = []
    for name in controllers:
        env = make_environment(scenario, name, render=True, **config)
        inner = interaction(env)
        viewer = inner.viewer_type(inner)
        inner.viewer = viewer
        envs.append(env)
        viewers.append(viewer)
        films.append(Film(name, [], [], env.metadata["render_fps"]))

    # After the end of an episode, its record is None.
    longest = 0.0
    for records in zip_longest(*(episode(env, seed) for env in envs)):
        for each, record in zip(films, records, strict=True):
            if record:
                each.records.append(record)
                longest = max(longest, record["planning_seconds"])
        for each, env, viewer in zip(films, envs, viewers, strict=True):
            viewer.longest = longest
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
    if path.suffix not in (".mp4", ".gif"):
        raise ValueError(
            f"cannot tell the format of {path}; its name must end in .mp4 or .gif"
        )
    if path.suffix == ".mp4":
        _imageio()


def scaled(pictures: Sequence[Picture], width: int) -> list[Picture]:
    """Scale pictures to a width [px], in proportion."""
    height, original_width = pictures[0].shape[:2]
    # Sides are even numbers, as mp4 requires.
    new_width = 2 * round(width / 2)
    new_height = 2 * round(height * width / original_width / 2)
    found = []
    for picture in pictures:
        image = Image.fromarray(picture)
        smaller = image.resize((new_width, new_height), Image.Resampling.HAMMING)
        found.append(np.asarray(smaller))
    return found


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
    pictures: Sequence[Picture],
    suffix: str,
    frames_per_second: float,
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


def _imageio() -> ModuleType:
    """Return the library that writes .mp4 files."""
    with needing("video"):
        import av  # noqa: F401
        import imageio.v3 as imageio
    return imageio


def _gif(pictures: Sequence[Picture], frames_per_second: float) -> bytes:
    """Return a GIF with one palette and no dithering.

    Then parts of the picture that stay the same take no space.
    """
    # Enough for flat colours and smooth edges.
    colors = 48
    some = np.concatenate([pictures[0], pictures[len(pictures) // 2], pictures[-1]])
    palette = Image.fromarray(some).quantize(colors, Image.Quantize.FASTOCTREE)
    images = [
        Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE)
        for each in pictures
    ]
    content = io.BytesIO()
    images[0].save(
        content,
        "GIF",
        save_all=True,
        append_images=images[1:],
        duration=1000 / frames_per_second,
        loop=0,
        optimize=True,
    )
    return content.getvalue()


@dataclass(frozen=True)
class Heading:
    """Set the sizes of a film's heading [px]."""

    height: int = 56
    """Height of the heading, with the bar at its bottom."""
    bar_height: int = 10
    """Height of the bar of time."""
    name_size: int = 26
    """Size of the controller's name."""
    numbers_size: int = 20
    """Size of the numbers."""


HEADING = Heading()


def side_by_side(films: Sequence[Film]) -> list[Picture]:
    """Put films of one scenario and of the same length one above the other.

    Roads are wide and low. The heading of each shows its controller, its mean reward
    per step and its time of planning and deciding so far; a bar shows this time,
    coloured by model, in one scale for all films.
    """
    longest = max(sum(map(_seconds, film.records)) for film in films)
    pictures = []
    for place in range(len(films[0].pictures)):
        parts = []
        for film in films:
            parts += [_heading(film, place, longest), film.pictures[place]]
        pictures.append(np.concatenate(parts))
    return pictures


def _seconds(record: Mapping) -> float:
    """Return the time of planning and deciding in a step [s]."""
    return float(record["planning_seconds"] + record["decision_seconds"])


def _heading(film: Film, place: int, longest: float) -> Picture:
    """Return the heading of the picture at a place of a film.

    Args:
        film: the film.
        place: number of the picture.
        longest: time at the full length of the bar [s].
    """
    records = film.records[: place + 1]
    width = film.pictures[place].shape[1]
    surface = pygame.Surface((width, HEADING.height))
    surface.fill(PALETTE.ink)

    # The bar of time so far, a piece for each step.
    top = HEADING.height - HEADING.bar_height
    end = 0.0
    for record in records:
        start = end
        end = end + _seconds(record) / longest * width
        piece = (round(start), top, round(end) - round(start), HEADING.bar_height)
        surface.fill(model_color(record["model"]), piece)

    # The name to the left, and the numbers to the right.
    middle = top // 2
    name = words(film.controller, HEADING.name_size, PALETTE.paper)
    surface.blit(name, name.get_rect(midleft=(PANEL_LAYOUT.margin, middle)))
    reward = np.mean([record["reward"] for record in records])
    taken = sum(map(_seconds, records))
    text = f"reward per step {reward:+.2f}      computing {1e3 * taken:.1f} ms"
    numbers = words(text, HEADING.numbers_size, PALETTE.paper)
    surface.blit(
        numbers, numbers.get_rect(midright=(width - PANEL_LAYOUT.margin, middle))
    )
    return pygame.surfarray.array3d(surface).swapaxes(0, 1)
