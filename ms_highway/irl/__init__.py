"""Learn a human's reward from recordings, predict drivers, and evaluate both.

Imports `ms_highway.recorded` and what stands below it.
"""

DEMONSTRATORS = {
    "keyboard": "a person, with the arrow keys",
    "maxent": (
        "knows where the other cars go, and draws its controls, segment by segment,"
        " from p(u) ~ exp(R(u) / temperature)"
    ),
}
"""Name and description of each driver that demonstrates for `ms-highway irl record`."""

TEMPERATURE = 1e-3
"""Default temperature of the driver ``maxent``, in units of the reward: controls vary
by up to 0.005 1/m and 3 m/s^2.
"""

SIMULATED_WEIGHTS = ("speed", "lane_alignment", "collision_risk")
"""Weights that are learned from simulated demonstrations."""

REAL_WEIGHTS = (
    *SIMULATED_WEIGHTS,
    "direction",
    "headway",
    "closing_speed",
    "induced_braking",
    "comfort_steering",
)
"""Weights that are learned from real drivers."""
