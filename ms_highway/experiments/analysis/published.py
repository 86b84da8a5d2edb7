"""Results that the paper published, for comparison with one's own.

Means over 30 episodes of Sripathy, Bobu, Brown and Dragan, "Dynamically Switching Human Prediction Models for Efficient
Planning" (ICRA 2021), from the logs that its authors released; seconds are those of their laptop.
"""

from typing import Any, NamedTuple

PUBLISHED_WITH: dict[str, Any] = {
    "semantics": "released",
    "solver": "gradient",
    "human_reward": "published",
    "costs": "published",
}
"""Settings of a comparison that may be compared with the paper's; all others are the usual ones."""


class Published(NamedTuple):
    """Means per step: the robot's reward, and the seconds of planning and of deciding about the model."""

    reward: float
    planning_seconds: float
    decision_seconds: float

    @property
    def seconds(self) -> float:
        """Planning and deciding together."""
        return self.planning_seconds + self.decision_seconds


ROWS = """\
stay_back  naive           -7.73  0.105  0
stay_back  turn             2.52  0.212  0
stay_back  switching:5      2.34  0.107  0.0095
stay_back  switching:0.4    2.59  0.123  0.0088
merger     naive            1.55  0.084  0
merger     turn             1.54  0.163  0
merger     tom              5.33  0.380  0
merger     switching:0.6    3.53  0.116  0.0134
merger     switching:0.1    5.54  0.145  0.0177
give_way   naive           -0.02  0.092  0
give_way   turn             0.34  0.181  0
give_way   tom              4.91  0.448  0
give_way   switching:0.03   1.78  0.173  0.0199
give_way   switching:0.01   4.44  0.254  0.0292"""

PUBLISHED = {
    (scenario, controller): Published(*map(float, numbers))
    for scenario, controller, *numbers in map(str.split, ROWS.splitlines())
}
"""By scenario and short name of the controller; the paper compared no others."""
