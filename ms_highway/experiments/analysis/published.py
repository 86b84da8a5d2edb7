"""Results that the paper published, for comparison with one's own.

Means over 30 episodes of Sripathy, Bobu, Brown and Dragan, "Dynamically Switching Human Prediction Models for Efficient
Planning" (ICRA 2021), from the logs that its authors released; seconds are those of their laptop.
"""

from dataclasses import dataclass
from typing import Any

__all__ = ["PUBLISHED", "PUBLISHED_WITH", "Published"]

PUBLISHED_WITH: dict[str, Any] = {
    "semantics": "released",
    "solver": "gradient",
    "human_reward": "published",
    "costs": "published",
}
"""Settings of a comparison that may be compared with the paper's; all others are the usual ones."""


@dataclass(frozen=True)
class Published:
    """Means per step: the robot's reward, and the seconds of planning and of deciding about the model."""

    reward: float
    planning_seconds: float
    decision_seconds: float = 0.0

    @property
    def seconds(self) -> float:
        """Planning and deciding together."""
        return self.planning_seconds + self.decision_seconds


PUBLISHED: dict[tuple[str, str], Published] = {
    ("stay_back", "naive"): Published(-7.73, 0.105),
    ("stay_back", "turn"): Published(2.52, 0.212),
    ("stay_back", "switching:5"): Published(2.34, 0.107, 0.0095),
    ("stay_back", "switching:0.4"): Published(2.59, 0.123, 0.0088),
    ("merger", "naive"): Published(1.55, 0.084),
    ("merger", "turn"): Published(1.54, 0.163),
    ("merger", "tom"): Published(5.33, 0.380),
    ("merger", "switching:0.6"): Published(3.53, 0.116, 0.0134),
    ("merger", "switching:0.1"): Published(5.54, 0.145, 0.0177),
    ("give_way", "naive"): Published(-0.02, 0.092),
    ("give_way", "turn"): Published(0.34, 0.181),
    ("give_way", "tom"): Published(4.91, 0.448),
    ("give_way", "switching:0.03"): Published(1.78, 0.173, 0.0199),
    ("give_way", "switching:0.01"): Published(4.44, 0.254, 0.0292),
}
"""By scenario and short name of the controller; the paper compared no others."""
