"""Read, record and smooth driving: Minari data sets, CommonRoad scenarios, demonstrators.

Imports `ms_highway.envs` and what stands below it.
"""

from typing import Literal, TypeAlias

Driver: TypeAlias = Literal["keyboard", "optimal", "maxent", "mpc"]

DRIVERS = {
    "keyboard": "a person, with the arrow keys",
    "optimal": "window by window, the local optimum of the reward among cars whose routes it knows",
    "maxent": "like optimal, but its controls are drawn from p(u) ~ exp(R(u) / temperature)",
    "mpc": "the package's planner, which replans every step and expects the others to keep their velocity",
}
"""Name and description of each driver."""

TEMPERATURE = 1e-3
"""Of the driver ``maxent``, in reward; controls then vary by up to 0.005 1/m and 3 m/s^2."""
