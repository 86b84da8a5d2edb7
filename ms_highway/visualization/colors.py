"""The colours of videos, as Matplotlib takes them."""

from ms_highway.envs.graphics import Color, model_color

__all__ = ["choosing_shades", "color_of", "paint"]

SHADES = {
    "switching": ["#3d4450", "#8a93a5", "#b9c0cc", "#1b1f27"],
    "learned": ["#7d52c9", "#a98be0", "#cfc0ee", "#5a35a0"],
}
OTHER_SHADES = ["#12908e", "#62bcb9", "#a9dad8", "#0b6462"]


def color_of(model: str) -> str:
    """Return the colour of a human model in figures, as it is in videos."""
    return paint(model_color(model))


def choosing_shades(kind: str) -> list[str]:
    """Return shades of a colour for controllers that choose models online, by their kind; the last one is for lines."""
    return SHADES.get(kind, OTHER_SHADES)


def paint(color: Color) -> str:
    """Return a colour of red, green and blue from 0 to 255 as Matplotlib takes it."""
    return "#{:02x}{:02x}{:02x}".format(*color)
