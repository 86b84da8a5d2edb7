"""Drive stock scenes of highway-env with this package's drivers and with peers, in the same episodes, and measure both.

Imports what `ms_highway.benchmarks` may import; its names, here, import nothing that computes.
"""

import re
from collections.abc import Iterable

SCENES = (
    *("highway-fast-v0", "merge-v1", "merge-v0", "roundabout-v1", "roundabout-v0", "exit-v1", "exit-v0"),
    *("intersection-v2", "intersection-v1", "intersection-v0", "two-way-v0", "u-turn-v1", "u-turn-v0"),
    *("racetrack-v1", "racetrack-v0"),
)
"""Stock scenes that are measured by default, in all versions, the newest first."""

OTHER_SCENES = ("highway-v0", "racetrack-oval-v1", "racetrack-oval-v0")

RECORDED = "recorded"
"""The scene of recorded traffic, with kinds of traffic and drivers of its own."""

RECORDED_ID = "ms_highway:ms-highway/recorded-v0"
RECORDED_TRAFFIC = ("learned", "replay", "idm")
EGOS = ("problem", "changing")

INTENTIONS = "+intentions"
"""End of the names of drivers that see which way others take."""

HUMAN = "human"
"""The driver that goes as the vehicle was recorded to whose place the ego takes."""

DRIVERS = ("priced", "fixed:naive", "fixed:idm", "fixed:tom", "idm")
"""Drivers that are measured by default."""

TRAFFIC = {
    "idm": "highway_env.vehicle.behavior.IDMVehicle",
    "aggressive": "highway_env.vehicle.behavior.AggressiveVehicle",
    "commuter": "ms_highway.vehicle.CommuterVehicle",
}
"""Types of other vehicles, by name."""


def known_scenes(names: Iterable[str]) -> list[str]:
    """Return identifiers of scenes, each once; a name without a version stands for all versions, the newest first.

    Raises:
        ValueError: for one that is not known.
    """
    scenes, every = [], (*SCENES, *OTHER_SCENES, RECORDED)
    for name in names:
        known = [scene for scene in every if name in (scene, re.sub(r"-v\d+$", "", scene))]
        if not known:
            raise ValueError(f"unknown scene {name!r}; the scenes are {', '.join(every)}")
        scenes += known
    return list(dict.fromkeys(scenes))


def driver_config(name: str) -> dict:
    """Return the configuration for `ms_highway.drive` of a driver of this package, such as ``priced:2+intentions``."""
    return {"driver": name.removesuffix(INTENTIONS), "intentions": name.endswith(INTENTIONS)}
