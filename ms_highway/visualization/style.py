"""The style of figures, their files, and the colours of videos for Matplotlib."""

import io
from collections.abc import Iterable, Iterator
from itertools import cycle

from matplotlib import rc_context
from matplotlib.figure import Figure

from ms_highway.envs.registry import controller_config, priced_types
from ms_highway.envs.viewer import model_color
from ms_highway.planning.ladders import is_model

SHADES = {
    "switching": ["#3d4450", "#8a93a5", "#b9c0cc", "#1b1f27"],
    "learned": ["#7d52c9", "#a98be0", "#cfc0ee", "#5a35a0"],
}
OTHER_SHADES = ["#12908e", "#62bcb9", "#a9dad8", "#0b6462"]

DPI = 160

styled = rc_context(
    {
        "axes.axisbelow": True,
        "axes.spines.right": False,
        "axes.spines.top": False,
        "figure.constrained_layout.use": True,
        "grid.color": "#eeeeee",
        "legend.frameon": False,
    }
)
"""Decorator of functions that draw a figure: a light grid, no frame above and to the right."""


def color_of(model: str) -> str:
    """Return the colour of a human model in figures, the same as in videos."""
    return "#{:02x}{:02x}{:02x}".format(*model_color(model))


def choosing_shades(kind: str) -> list[str]:
    """Return shades of a colour for controllers of a kind that choose models online; the last one is for lines."""
    return SHADES.get(kind, OTHER_SHADES)


def controller_colors(controllers: Iterable[str]) -> list[str]:
    """Return the model's colour for a fixed model, shades of its kind's colour for an online choice, else greys."""
    colors, left = [], dict[str, Iterator[str]]()
    for name in controllers:
        kind = controller_config(name)["type"]
        shades = left.setdefault(kind, cycle(choosing_shades(kind if kind in priced_types() else "switching")))
        colors.append(color_of(name) if is_model(name) else next(shades))
    return colors


def content(figure: Figure, kind: str = "png") -> bytes:
    """Return the content of a figure's file: ``png``, ``pdf`` with fonts that publishers accept, or ``svg``."""
    written = io.BytesIO()
    with rc_context({"pdf.fonttype": 42}):  # TrueType
        figure.savefig(written, format=kind, dpi=DPI)
    return written.getvalue()
