"""The style of figures, how controllers look in them, and the files of figures."""

import io
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from matplotlib import style
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from ms_highway.envs.colors import model_color
from ms_highway.envs.registry import controller_config
from ms_highway.planning.ladders import is_model

SHADES = {
    "switching": ("#3d4450", "#8a93a5", "#1b1f27", "#b9c0cc"),
    "learned": ("#7d52c9", "#a98be0", "#5a35a0", "#cfc0ee"),
    "random": ("#2e8b57", "#7cbf98", "#1c5736", "#b5dcc5"),
    "schedule": ("#8a6d3b", "#bda273", "#5c4724", "#dbcba8"),
    "budget": ("#1f5fbf", "#6f9be0", "#143f80", "#b3cbf0"),
    "nearest": ("#d9822b", "#ecb27a", "#985717", "#f5d6b5"),
    "driver": ("#a0522d", "#c98a6c", "#6e371d", "#e3c0ae"),
    "agent": ("#556b2f", "#93a86c", "#37461d", "#c6d2ae"),
}
"""Shades of a colour for the controllers of each type, besides fixed models."""

styled = style.context(
    [
        "default",
        {
            "axes.axisbelow": True,
            "axes.spines.right": False,
            "axes.spines.top": False,
            "figure.constrained_layout.use": True,
            "grid.color": "#eeeeee",
            "legend.frameon": False,
            # TrueType, which publishers accept.
            "pdf.fonttype": 42,
            # Names of controllers, files and scenarios are texts, whatever they
            # contain.
            "text.parse_math": False,
        },
    ]
)
"""Decorator of functions that draw a figure.

Figures have a light grid, and no frame above and to the right. They do not depend on
the user's ``matplotlibrc``, such as its ``text.usetex``, and no text in them is
mathematics.
"""


class Look(NamedTuple):
    """How a controller looks in figures.

    Attributes:
        color: of its line, bar or points.
        line: style of its line.
        marker: of its points.
        label: its name, shortened.
    """

    color: str
    line: str
    marker: str
    label: str


def color_of(model: str) -> str:
    """Return the colour of a human model in figures, the same as in videos."""
    return "#{:02x}{:02x}{:02x}".format(*model_color(model))


def looks(controllers: Iterable[str]) -> dict[str, Look]:
    """Return how each controller looks, by its name.

    No two have the same label, or the same colour, line and marker. A fixed model has
    its colour in videos, and other controllers a shade of the colour of their type. A
    controller looks the same in all figures whose controllers begin with the same ones.
    """
    lines = ("-", "--", ":", "-.")
    markers = ("o", "s", "^", "D", "v", "P", "X")
    found: dict[str, Look] = {}
    labels = Counter[str]()
    same_shades = Counter[tuple[str, ...]]()
    used = set[tuple[str, str, str]]()
    for name in dict.fromkeys(controllers):
        shades = _shades(name)
        color = shades[same_shades[shades] % len(shades)]
        same_shades[shades] += 1

        # The next line and marker that no controller of this colour has; of hundreds
        # of controllers, some look alike.
        first = len(found)
        forms = []
        for place in range(first, first + len(lines) * len(markers)):
            line = lines[place % len(lines)]
            marker = markers[place % len(markers)]
            forms.append((color, line, marker))
        form = next((form for form in forms if form not in used), forms[0])
        used.add(form)

        label = short(name)
        labels[label] += 1
        if labels[label] > 1:
            label = f"{label} ({labels[label]})"
        found[name] = Look(*form, label)
    return found


def _shades(name: str) -> tuple[str, ...]:
    """Return the shades for a controller and those like it."""
    config = controller_config(name)
    kind = config["type"]
    model = config.get("model", "")
    if kind == "fixed" and is_model(model):
        base = model_color(model)
        return tuple(_variant(base, strength) for strength in (1.0, 0.55, 1.4, 0.3))
    other_shades = ("#12908e", "#62bcb9", "#0b6462", "#a9dad8")
    return SHADES.get(kind, other_shades)


def _variant(color: Sequence[int], strength: float) -> str:
    """Return a variant of a colour.

    A strength below 1 mixes it with white, and one above 1 darkens it.
    """
    if strength > 1:
        parts = [round(part / strength) for part in color]
    else:
        parts = [round(255 - strength * (255 - part)) for part in color]
    return "#{:02x}{:02x}{:02x}".format(*parts)


def short(name: str) -> str:
    """Return a name as a label, without the middle of long names."""
    longest = 28
    half = longest // 2
    label = name if len(name) <= longest else f"{name[: half - 1]}…{name[-half:]}"
    # Legends would hide a label that begins with _.
    return f" {label}" if label.startswith("_") else label


def legend(figure: Figure, handles: Iterable[Artist], labels: Iterable[str]) -> None:
    """Draw a legend below all axes, in as many columns as there is room for."""
    # Widths of a letter, and of a line with its spaces [in].
    letter = 0.085
    handle = 0.6

    texts = list(labels)
    width = handle + letter * max(map(len, texts))
    columns = int(figure.get_figwidth() / width)
    figure.legend(
        list(handles),
        texts,
        loc="outside lower center",
        ncols=min(max(columns, 1), len(texts)),
    )


def plain_ticks(value: float, _: float) -> str:
    """Return the label of a tick, such as 0.01, without powers of ten."""
    text = f"{value:g}"
    return text.replace("-", "\N{MINUS SIGN}", 1) if value < 0 else text


@styled
def content(figure: Figure, kind: str = "png") -> bytes:
    """Return the content of a figure's file: ``png``, ``pdf`` or ``svg``."""
    written = io.BytesIO()
    figure.savefig(written, format=kind, dpi=160)
    return written.getvalue()


def drawn(
    figures: Mapping[str, Callable[[], Figure]],
    kind: str = "png",
) -> dict[str, bytes]:
    """Return the contents of the figures' files, by name.

    A figure that cannot be drawn is left out, with a warning.
    """
    found = {}
    for name, draw in figures.items():
        try:
            found[name] = content(draw(), kind)
        except Exception as error:
            # Results are whole without it, whatever fails.
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            warnings.warn(
                f"the figure {name} is left out, as it cannot be drawn ({reason})",
                stacklevel=2,
            )
    return found
