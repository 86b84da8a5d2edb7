"""Drive the stock environments of highway-env: a wrapper, and the properties of each scene that it uses.

Imports what `ms_highway.envs` does.
"""

from ms_highway.envs.road.driven import Driven, drive
from ms_highway.envs.road.stock import replace_ego

__all__ = [
    "Driven",
    "drive",
    "driven",
    "graphics",
    "replace_ego",
    "settings",
    "stock",
]
