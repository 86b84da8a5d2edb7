"""Drive the stock environments of highway-env: a wrapper, and what it needs to know of each scene.

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
