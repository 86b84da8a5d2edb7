"""Define the colours of drawings and of human models, and describe each model."""

from dataclasses import dataclass
from typing import TypeAlias

from ms_highway.planning.ladders import MODELS, human_model, is_model

Color: TypeAlias = tuple[int, ...]
"""Red, green and blue, from 0 to 255."""


@dataclass(frozen=True)
class Palette:
    """Colours of pictures."""

    ink: Color = (32, 36, 44)
    """Colour of texts and curves."""
    faint: Color = (125, 130, 140)
    """Colour of scales, and of what has no model."""
    paper: Color = (250, 250, 247)
    """Colour of panels, and of texts and rims on the road."""
    cone: Color = (255, 120, 20)
    """Colour of traffic cones."""
    grid: Color = (215, 218, 224)
    """Colour of lines within charts."""
    ground: Color = (205, 218, 195)
    """Colour beside the road."""
    asphalt: Color = (96, 100, 106)
    """Colour of the road."""


PALETTE = Palette()

MODEL_COLORS: dict[str, Color] = {
    "naive": (112, 178, 214),
    "idm": (120, 170, 90),
    "turn": (240, 180, 50),
    "tom": (214, 68, 140),
}
"""Colours of the package's human models."""

MODEL_MEANINGS = {
    "naive": "the human keeps its velocity",
    "idm": "the human minds the car ahead",
    "turn": "the human minds only itself",
    "tom": "the human responds to the robot",
}
"""What the package's human models expect of the human."""


def model_color(name: str | None) -> Color:
    """Return the colour of a human model, grey without one.

    Added models get colours in their order. A model with an effort has its own shade:
    fewer steps are lighter, and starting from the last plan is darker.
    """
    if name is None or not is_model(name):
        return PALETTE.faint
    model = human_model(name)
    color = _base_color(type(model).name)

    # Mixed with white: without steps 60 % of it, from 20 steps on none.
    full = 20
    white = 0.6 * max(0.0, 1 - (model.steps or full) / full)
    brightness = 0.8 if model.warm else 1
    return tuple(round((part + white * (255 - part)) * brightness) for part in color)


def _base_color(name: str) -> Color:
    """Return the colour of a human model without an effort."""
    if name in MODEL_COLORS:
        return MODEL_COLORS[name]
    others = ((150, 110, 200), (160, 120, 90), (90, 150, 150))
    added = [known for known in MODELS if known not in MODEL_COLORS]
    return others[added.index(name) % len(others)]


def model_meaning(name: str) -> str:
    """Return in a few words what a human model expects of the human.

    The text is empty for added models.
    """
    if not is_model(name):
        return ""
    return MODEL_MEANINGS.get(type(human_model(name)).name, "")
