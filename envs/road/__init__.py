"""Drive the stock environments of highway-env: a wrapper, a policy, and what they need to know of each scene.

Imports what `ms_highway.envs` does.
"""

from ms_highway.envs.road.driven import Driven, drive
from ms_highway.envs.road.policy import RoadPolicy
from ms_highway.envs.road.stock import replace_ego

__all__ = [
    "Driven",
    "RoadPolicy",
    "drive",
    "driven",
    "graphics",
    "policy",
    "replace_ego",
    "settings",
    "stock",
]
