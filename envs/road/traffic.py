"""Undo what `IntersectionEnv` does to highway-env's drivers: its reset changes their class for the whole process."""

import runpy
from functools import cache
from types import MappingProxyType
from typing import Any

from highway_env.envs import IntersectionEnv
from highway_env.vehicle import behavior

OVERWRITTEN = MappingProxyType({"DISTANCE_WANTED": 7, "COMFORT_ACC_MAX": 6, "COMFORT_ACC_MIN": -3})
"""What the reset of an `IntersectionEnv` sets on the class of its traffic."""


@cache
def _originals() -> dict[str, type]:
    """Return the classes of `behavior` as they are before anything has changed them."""
    fresh = runpy.run_path(behavior.__file__)
    return {name: kind for name, kind in fresh.items() if isinstance(kind, type) and kind.__module__ == "<run_path>"}


def restore_traffic(env: Any) -> None:
    """Give highway-env's drivers their own distances and accelerations back, unless the environment sets them itself.

    Only the values of an `IntersectionEnv` are undone, all of them together; values that somebody else has set, and
    classes of others, are left alone.

    Args:
        env: a highway-env environment, or a wrapper of one, that is about to be reset.
    """
    if isinstance(env.unwrapped, IntersectionEnv):
        return
    for name, original in _originals().items():
        kind = getattr(behavior, name)
        if any(vars(kind).get(key) != value for key, value in OVERWRITTEN.items()):
            continue
        for key in OVERWRITTEN:
            if key in vars(original):
                setattr(kind, key, vars(original)[key])
            else:
                delattr(kind, key)
