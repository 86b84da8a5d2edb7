"""Learn a human's reward from recordings: windows, maximum entropy, prediction, evaluation.

Imports `ms_highway.recorded` and what stands below it.
"""

from typing import Literal, TypeAlias

Others: TypeAlias = Literal["predicted", "recorded", "coasting"]
"""Motion of the other cars: predicted together with the driver; as recorded, which leaks the future; at constant
velocity."""

SIMULATED_WEIGHTS = ("speed", "lane_alignment", "collision_risk")
"""Weights that are learned from simulated demonstrations."""

REAL_WEIGHTS = (*SIMULATED_WEIGHTS, "direction", "headway", "closing_speed", "induced_braking", "comfort_steering")
"""Weights that are learned from real drivers."""
