"""Compare drivers of this package and others in stock scenes of highway-env, from the
same starts.

Imports what `ms_highway.benchmarks` may import. This module itself holds names only,
and imports nothing heavy.
"""

import re
from collections.abc import Iterable

SCENES = (
    *(
        "highway-fast-v0",
        "merge-v1",
        "merge-v0",
        "roundabout-v1",
        "roundabout-v0",
        "exit-v1",
        "exit-v0",
    ),
    *(
        "intersection-v2",
        "intersection-v1",
        "intersection-v0",
        "two-way-v0",
        "u-turn-v1",
        "u-turn-v0",
    ),
    *("racetrack-v1", "racetrack-v0"),
)
"""Stock scenes that are measured by default: all versions, the newest first."""

OTHER_SCENES = ("highway-v0", "racetrack-oval-v1", "racetrack-oval-v0")

RECORDED = "recorded"
"""Name of the scene of recorded traffic, which has kinds of traffic and a driver of its
own.
"""

RECORDED_ID = "ms_highway:ms-highway/recorded-v0"
RECORDED_TRAFFIC = ("learned", "replay", "idm")
EGOS = ("problem", "changing")

INTENTIONS = "+intentions"
"""Suffix of the names of drivers that know the routes of others."""

HUMAN = "human"
"""Name of the driver that repeats the recorded drive of the vehicle that the ego
replaces.
"""

DRIVERS = ("priced", "fixed:naive", "fixed:idm", "fixed:tom", "idm")
"""Drivers that are measured by default."""

TRAFFIC = {
    "idm": "highway_env.vehicle.behavior.IDMVehicle",
    "aggressive": "highway_env.vehicle.behavior.AggressiveVehicle",
    "commuter": "ms_highway.vehicle.CommuterVehicle",
}
"""Types of other vehicles in stock scenes, by name."""


def known_scenes(names: Iterable[str]) -> list[str]:
    """Return identifiers of scenes, each once; a name without a version stands for all
    versions, the newest first.

    Raises:
        ValueError: for an unknown scene.
    """
    scenes = []
    every = (*SCENES, *OTHER_SCENES, RECORDED)
    for name in names:
        known = [
            scene for scene in every if name in (scene, re.sub(r"-v\d+$", "", scene))
        ]
        if not known:
            raise ValueError(
                f"unknown scene {name!r}; the scenes are {', '.join(every)}"
            )
        scenes += known
    return list(dict.fromkeys(scenes))


def driver_config(name: str) -> dict:
    """Return the configuration that `ms_highway.drive` takes for a driver's name, such
    as ``priced:2+intentions``.
    """
    return {
        "driver": name.removesuffix(INTENTIONS),
        "intentions": name.endswith(INTENTIONS),
    }
