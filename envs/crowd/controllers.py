"""Stand-in."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ms_highway.planning.crowd import RUNGS


@dataclass(frozen=True)
class Fixed:
    """Stand-in."""

    model: str
    type = "fixed"
    price = float("nan")
    budget = None
    needs_costs = False

    def rule(self, costs: Any) -> Any:
        return lambda state: np.full(len(state) - 1, RUNGS.index(self.model))


def crowd_settings(config: Any) -> Fixed:
    """Stand-in."""
    if config.get("type") != "fixed":
        raise ValueError(f"config['controller'] is {config!r}; unknown")
    return Fixed(config["model"])


def crowd_controller_config(text: str) -> dict[str, Any]:
    """Stand-in."""
    if text not in RUNGS:
        raise ValueError(f"unknown controller {text!r}; the controllers are {RUNGS}")
    return {"type": "fixed", "model": text}


CrowdControllerSettings = Fixed
