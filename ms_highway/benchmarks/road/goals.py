"""What success means in each stock scene, and where its route leads."""

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

__all__ = ["LONGEST", "has_goal", "is_reached", "route_to_goal"]

LONGEST = 60.0
"""Seconds after which an episode ends in scenes that have no end of their own: a car may stand still."""

MERGED = 370.0  # m, where merge scenes end
RING_EXIT = ("nx", "nxs")  # nodes of a roundabout between which the ego's way out of the ring begins

DESTINATIONS = {"merge": "d", "roundabout": "nxr", "intersection": "o1", "u-turn": "d"}
"""Node of the road network to which the route of the ego leads, by kind of scene."""

GOALS: dict[str, Callable[[Any, Mapping[str, Any]], bool]] = {
    "merge": lambda env, info: env.vehicle.position[0] > MERGED,
    "roundabout": lambda env, info: env.vehicle.lane_index[0] in RING_EXIT,
    "exit": lambda env, info: info["is_success"],
    "intersection": lambda env, info: env.has_arrived(env.vehicle),
}
"""Whether the goal is reached at the end of an episode, of an environment and its last ``info``, by kind of scene."""


def _kind(scene: str) -> str:
    return scene.rpartition("-")[0]


def has_goal(scene: str) -> bool:
    """Return whether a scene has a goal beside driving without an accident."""
    return _kind(scene) in GOALS


def is_reached(scene: str, env: Any, info: Mapping[str, Any], crashed: bool, off_road: bool) -> bool:
    """Return whether an episode is a success.

    It is none after a crash. In ``merge``, the ego has passed the end of the ramp; in ``roundabout``, it has left the
    ring by its exit when the time is over; in ``exit``, ``info["is_success"]`` says so at the end; in ``intersection``,
    ``has_arrived`` does. In the other scenes, the ego has stayed on the road until the end.

    Args:
        scene: its identifier.
        env: the environment, unwrapped, after its last step.
        info: of the last step.
        crashed: whether the ego has crashed.
        off_road: whether it has left the road in any frame.
    """
    reached = GOALS[_kind(scene)](env, info) if has_goal(scene) else not off_road
    return bool(reached) and not crashed


def route_to_goal(scene: str, env: Any) -> list[tuple[str, str, int | None]] | None:
    """Return the roads of the ego's way to the goal, without a lane where each will do; None without a destination.

    Args:
        scene: its identifier.
        env: the environment, unwrapped, after a reset.
    """
    if _kind(scene) == "exit":
        last = env.config["lanes_count"]
        return [("0", "1", last - 1), ("1", "2", last), ("2", "exit", 0)]
    if _kind(scene) not in DESTINATIONS:
        return None
    start, onward, _ = env.vehicle.lane_index
    nodes = [start, *env.road.network.shortest_path(onward, DESTINATIONS[_kind(scene)])]
    return [(one, other, None) for one, other in pairwise(nodes)]
