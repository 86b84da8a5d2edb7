"""The colours of videos, as Matplotlib takes them."""

from ms_highway.envs.graphics import Color, model_color

__all__ = ["color_of", "paint"]


def color_of(model: str) -> str:
    """Return the colour of a human model in figures, as it is in videos."""
    return paint(model_color(model))


def paint(color: Color) -> str:
    """Return a colour of red, green and blue from 0 to 255 as Matplotlib takes it."""
    return "#{:02x}{:02x}{:02x}".format(*color)
