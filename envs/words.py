"""Draw lines of text."""

from functools import cache
from pathlib import Path

import matplotlib
import pygame
import pygame.freetype

__all__ = ["Color", "words"]

Color = tuple[int, int, int]


def words(text: str, size: int, color: Color) -> pygame.Surface:
    """Draw a line of text in a kerned font of ``size`` px, on a surface of the same height for every text.

    The font is Matplotlib's, so that pictures are the same on every machine. It is opened anew each time, since closing
    any of highway-env's viewers ends the font module.
    """
    pygame.freetype.init()
    font = pygame.freetype.Font(_font_file(), size)
    font.kerning = font.pad = True
    surface, _ = font.render(text, color)
    return surface


@cache
def _font_file() -> str:
    return str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf")
