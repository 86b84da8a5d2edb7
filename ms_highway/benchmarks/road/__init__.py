"""Compare drivers in stock scenes of highway-env, from the same starts.

The drivers are of this package and others. Imports what `ms_highway.benchmarks` may
import. This module itself holds names only, and imports nothing heavy.
"""

import re
from collections.abc import Iterable

SCENES = (
    "highway-fast-v0",
    "merge-v1",
    "merge-v0",
    "roundabout-v1",
    "roundabout-v0",
    "exit-v1",
    "exit-v0",
    "intersection-v2",
    "intersection-v1",
    "intersection-v0",
    "two-way-v0",
    "u-turn-v1",
    "u-turn-v0",
    "racetrack-v1",
    "racetrack-v0",
)
"""Stock scenes that are measured by default: all versions, the newest first."""

OTHER_SCENES = ("highway-v0", "racetrack-oval-v1", "racetrack-oval-v0")
"""Stock scenes that are measured if they are named."""

RECORDED = "recorded"
"""Name of the scene of recorded traffic.

It has kinds of traffic and a driver of its own.
"""

RECORDED_TRAFFIC = ("learned", "replay", "idm")
"""Kinds of traffic in recordings, the default first."""

EGOS = ("problem", "changing")
"""Starts of the ego in recordings, the default first."""

INTENTIONS = "+intentions"
"""Suffix of the names of drivers that know the routes of others."""

DEFAULT_DRIVERS = ("priced", "fixed:naive", "fixed:idm", "fixed:tom", "idm")
"""Drivers that are measured by default."""

TRAFFIC = {
    "idm": "highway_env.vehicle.behavior.IDMVehicle",
    "aggressive": "highway_env.vehicle.behavior.AggressiveVehicle",
    "commuter": "ms_highway.vehicle.CommuterVehicle",
}
"""Types of other vehicles in stock scenes, by name."""


def known_scenes(names: Iterable[str]) -> list[str]:
    """Return identifiers of scenes, each once.

    A name without a version stands for all versions, the newest first.

    Raises:
        ValueError: for an unknown scene.
    """
    known = (*SCENES, *OTHER_SCENES, RECORDED)
    scenes = []
    for name in names:
        named = []
        for scene in known:
            without_version = re.sub(r"-v\d+$", "", scene)
            if name in (scene, without_version):
                named.append(scene)
        if not named:
            raise ValueError(
                f"unknown scene {name!r}; the scenes are {', '.join(known)}"
            )
        scenes += named
    return list(dict.fromkeys(scenes))


def driver_config(name: str) -> dict:
    """Return the configuration of `ms_highway.drive` for the name of a driver.

    Such a name is ``priced:2+intentions``.
    """
    return {
        "driver": name.removesuffix(INTENTIONS),
        "intentions": name.endswith(INTENTIONS),
    }
