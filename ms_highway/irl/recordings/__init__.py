"""Read, record and smooth driving: Minari data sets, CommonRoad scenarios, demonstrators.

Imports `ms_highway.envs` and what stands below it.
"""

from typing import Literal, TypeAlias

Driver: TypeAlias = Literal["keyboard", "maxent"]

DRIVERS = {
    "keyboard": "a person, with the arrow keys",
    "maxent": "knows where the other cars go, and draws its controls, window by window, from "
    "p(u) ~ exp(R(u) / temperature)",
}
"""Name and description of each driver."""

TEMPERATURE = 1e-3
"""Of the driver ``maxent``, in reward; controls then vary by up to 0.005 1/m and 3 m/s^2."""
