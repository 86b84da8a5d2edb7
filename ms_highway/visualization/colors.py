"""The colours of videos, as Matplotlib takes them, and of what lies below figures."""

from collections.abc import Iterable, Iterator
from itertools import cycle
from typing import Literal

from matplotlib.axes import Axes

from ms_highway.envs.registry import controller_config, priced_types
from ms_highway.envs.viewer import model_color
from ms_highway.planning.human_models import is_model

SHADES = {
    "switching": ["#3d4450", "#8a93a5", "#b9c0cc", "#1b1f27"],
    "learned": ["#7d52c9", "#a98be0", "#cfc0ee", "#5a35a0"],
}
OTHER_SHADES = ["#12908e", "#62bcb9", "#a9dad8", "#0b6462"]


def color_of(model: str) -> str:
    """Return the colour of a human model in figures, as it is in videos."""
    return "#{:02x}{:02x}{:02x}".format(*model_color(model))


def choosing_shades(kind: str) -> list[str]:
    """Return shades of a colour for controllers that choose models online, by their kind; the last one is for lines."""
    return SHADES.get(kind, OTHER_SHADES)


def controller_colors(controllers: Iterable[str]) -> list[str]:
    """Return a model's own colour for a fixed model, shades of its kind's for one that chooses online, else greys."""
    colors, left = [], dict[str, Iterator[str]]()
    for name in controllers:
        kind = controller_config(name)["type"]
        shades = left.setdefault(kind, cycle(choosing_shades(kind if kind in priced_types() else "switching")))
        colors.append(color_of(name) if is_model(name) else next(shades))
    return colors


def light_grid(axes: Axes, axis: Literal["both", "x", "y"] = "both") -> None:
    """Draw a light grid below what is drawn, without a frame above and to the right."""
    axes.grid(axis=axis, color="#eeeeee")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
