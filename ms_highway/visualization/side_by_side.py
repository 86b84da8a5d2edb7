"""Several films of the same start, shown together."""

from collections.abc import Sequence

import numpy as np
import pygame
from jaxtyping import UInt8

from ms_highway.envs.graphics import INK, MARGIN, PAPER, model_color, words
from ms_highway.visualization.video import Film, Picture

__all__ = ["HEADING_HEIGHT", "side_by_side"]

HEADING_HEIGHT = 56  # px
BAR_HEIGHT = 10  # px
NAME_SIZE, NUMBERS_SIZE = 26, 20  # px, of texts


def side_by_side(films: Sequence[Film]) -> list[Picture]:
    """Films that run at the same time, one above the other, since roads are wide and low.

    Above each stands its controller, its mean reward per step and its planning and deciding time so far; a bar shows
    that time, coloured by model, in one scale for all films. The last picture of a shorter film stays.

    Raises:
        ValueError: if the films differ in size or speed.
    """
    if len({(film.pictures[0].shape, film.frames_per_second) for film in films}) != 1:
        raise ValueError("films of several sizes or speeds cannot be shown together; film them in the same way")
    longest = max(_seconds(film)[-1] for film in films)
    return [
        np.concatenate([_titled(film, min(place, len(film.pictures) - 1), longest) for film in films])
        for place in range(max(len(film.pictures) for film in films))
    ]


def _seconds(film: Film) -> np.ndarray:
    """Return the time of planning and deciding from the start to each step [s]."""
    return np.cumsum([float(record["planning_seconds"] + record["decision_seconds"]) for record in film.records])


def _titled(film: Film, place: int, longest: float) -> Picture:
    """Return a picture of a film under its heading; ``longest`` [s] is the full length of the bar."""
    heading = _heading(film, place, film.pictures[0].shape[1], longest)
    return np.concatenate([heading, film.pictures[place]])


def _heading(film: Film, place: int, width: int, longest: float) -> UInt8[np.ndarray, "h w 3"]:
    surface = pygame.Surface((width, HEADING_HEIGHT))
    surface.fill(INK)
    taken, middle = _seconds(film)[: place + 1], (HEADING_HEIGHT - BAR_HEIGHT) // 2
    reward = np.mean([record["reward"] for record in film.records[: place + 1]])
    name = words(film.controller, NAME_SIZE, PAPER)
    surface.blit(name, name.get_rect(midleft=(MARGIN, middle)))
    text = f"reward per step {reward:+.2f}      computing {1e3 * taken[-1]:.1f} ms"
    numbers = words(text, NUMBERS_SIZE, PAPER)
    surface.blit(numbers, numbers.get_rect(midright=(width - MARGIN, middle)))
    ends = np.concatenate([[0], taken]) / longest * width
    for record, start, end in zip(film.records, ends, ends[1:], strict=False):
        color = model_color(record["model"])
        surface.fill(color, (round(start), HEADING_HEIGHT - BAR_HEIGHT, round(end) - round(start), BAR_HEIGHT))
    return pygame.surfarray.array3d(surface).swapaxes(0, 1)
