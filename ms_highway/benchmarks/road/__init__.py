"""Drive stock scenes of highway-env with this package's drivers and with peers, in the same episodes, and measure both.

Imports what `ms_highway.benchmarks` may import; its names, here, import nothing that computes.
"""

import re
from collections.abc import Iterable
from typing import Any

SCENES = (
    *("highway-fast-v0", "merge-v0", "roundabout-v0", "exit-v0", "intersection-v0"),
    *("intersection-v2", "two-way-v0", "u-turn-v0", "racetrack-v0"),
)
"""Stock scenes that are measured by default."""

OTHER_SCENES = ("highway-v0", "merge-v1", "roundabout-v1", "exit-v1", "u-turn-v1", "racetrack-v1", "racetrack-oval-v0")

PEERS = ("idm", "idle", "random")
"""Drivers that are not this package's."""

DRIVERS = ("priced", "fixed:naive", "fixed:idm", "fixed:turn", "fixed:tom", "proposals", *PEERS)
"""Drivers that are measured by default."""

TRAFFIC = {
    "idm": "highway_env.vehicle.behavior.IDMVehicle",
    "commuter": "ms_highway.vehicle.CommuterVehicle",
    "unyielding": "ms_highway.benchmarks.road.peers.UnyieldingVehicle",
}
"""Types of other vehicles, by name."""


def known_scenes(names: Iterable[str]) -> list[str]:
    """Return identifiers of scenes, each once; a name without a version stands for version 0.

    Raises:
        ValueError: for one that is not known.
    """
    scenes = list(dict.fromkeys(name if re.search(r"-v\d+$", name) else f"{name}-v0" for name in names))
    for name in scenes:
        if name not in SCENES + OTHER_SCENES:
            raise ValueError(f"unknown scene {name!r}; the scenes are {', '.join(SCENES + OTHER_SCENES)}")
    return scenes


def driver_config(name: str) -> dict[str, Any]:
    """Return the configuration, for `ms_highway.drive`, of a driver of this package, such as ``priced:2+traits``."""
    driver, *suffixes = re.split(r"(?=\+traits|\+belief)", name)
    return {"driver": driver, "traits": "+traits" in suffixes, "belief": "+belief" in suffixes}
