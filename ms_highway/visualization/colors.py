"""The colours of videos, as Matplotlib takes them, and of what lies below figures."""

from collections.abc import Sequence
from itertools import cycle
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from ms_highway.envs.controllers import CHOOSING
from ms_highway.envs.graphics import model_color
from ms_highway.envs.short_names import controller_config
from ms_highway.planning.human_models import is_model

SHADES = {
    "switching": ["#3d4450", "#8a93a5", "#b9c0cc", "#1b1f27"],
    "learned": ["#7d52c9", "#a98be0", "#cfc0ee", "#5a35a0"],
}
OTHER_SHADES = ["#12908e", "#62bcb9", "#a9dad8", "#0b6462"]


def color_of(model: str) -> str:
    """Return the colour of a human model in figures, as it is in videos."""
    return "#{:02x}{:02x}{:02x}".format(*model_color(model))


def model_colors(models: Sequence[str]) -> ListedColormap:
    """Return the colours of human models by their places."""
    return ListedColormap([color_of(model) for model in models])


def choosing_shades(kind: str) -> list[str]:
    """Return shades of a colour for controllers that choose models online, by their kind; the last one is for lines."""
    return SHADES.get(kind, OTHER_SHADES)


def controller_colors(controllers: Sequence[str]) -> list[str]:
    """Return a model's own colour for a fixed model, shades of its kind's for one that chooses online, else greys."""
    kinds = [kind if (kind := controller_config(name)["type"]) in CHOOSING else "switching" for name in controllers]
    shades = {kind: cycle(choosing_shades(kind)) for kind in kinds}
    pairs = zip(controllers, kinds, strict=True)
    return [color_of(name) if is_model(name) else next(shades[kind]) for name, kind in pairs]


def light_grid(axes: Axes, axis: Literal["both", "x", "y"] = "both") -> None:
    """Draw a light grid below what is drawn, without a frame above and to the right."""
    axes.grid(axis=axis, color="#eeeeee")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
