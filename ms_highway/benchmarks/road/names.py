"""What scenes and drivers are called."""

import re
from collections.abc import Iterable
from importlib.util import find_spec

__all__ = ["DRIVERS", "PEERS", "SCENES", "check_drivers", "known_scenes"]

SCENES = (
    "highway-fast-v0",
    "merge-v0",
    "roundabout-v0",
    "exit-v0",
    "intersection-v0",
    "intersection-v2",
    "two-way-v0",
    "u-turn-v0",
    "racetrack-v0",
)
"""Stock scenes that are measured by default."""

OTHER_SCENES = ("highway-v0", "merge-v1", "roundabout-v1", "exit-v1", "u-turn-v1", "racetrack-v1", "racetrack-oval-v0")

PEERS = ("idm", "idle", "random", "dqn")
"""Drivers that are not this package's."""

DRIVERS = (
    *("switching", "fixed:naive", "fixed:idm", "fixed:turn", "fixed:tom", "proposals"),
    *("idm", "idle", "random"),
)
"""Drivers that are measured by default."""

NUMBER = r":(\d+\.?\d*|\.\d+)(e[+-]?\d+)?"
OWN = re.compile(rf"(switching({NUMBER})?|budget{NUMBER}|fixed:(naive|idm|turn|tom)|proposals)(\+traits)?(\+belief)?")


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


def check_drivers(drivers: Iterable[str], scenes: Iterable[str]) -> None:
    """Refuse drivers that are not known, or that cannot drive.

    Args:
        drivers: their names.
        scenes: identifiers of the scenes that they are to drive in.

    Raises:
        ValueError: for an unknown one, or where ``dqn`` is to drive with continuous actions.
        ImportError: for ``dqn`` without stable-baselines3.
    """
    for name in drivers:
        if name not in PEERS and not OWN.fullmatch(name):
            known = f"{', '.join(DRIVERS)}, dqn, switching:LAMBDA, budget:MILLISECONDS, DRIVER[+traits][+belief]"
            raise ValueError(f"unknown driver {name!r}; the drivers are {known}")
        if name == "dqn":
            continuous = [scene for scene in scenes if scene.startswith("racetrack")]
            if continuous:
                raise ValueError(f"dqn needs discrete actions; leave out {', '.join(continuous)}")
            if find_spec("stable_baselines3") is None:
                raise ImportError('dqn needs stable-baselines3: pip install "ms-highway[learning]"')
