"""Drive the stock environments of highway-env.

There are a wrapper for them, the robot, and its driver. Imports `ms_highway.envs` and
what stands below it.
"""

from ms_highway.road.driven import Driven, drive
from ms_highway.road.stock import replace_ego

__all__ = [
    "Driven",
    "drive",
    "driven",
    "graphics",
    "replace_ego",
    "settings",
    "stock",
]
