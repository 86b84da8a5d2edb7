"""What success means in each stock scene, and where the ego's route leads."""

from itertools import pairwise
from typing import Any

from highway_env.envs import ExitEnv, UTurnEnv

from ms_highway.envs.road.goals import destination_of, success

__all__ = ["LONGEST", "is_reached", "route_to_goal"]

LONGEST = 60.0
"""Seconds after which an episode ends in scenes that have no end of their own: a car may stand still."""


def is_reached(env: Any, crashed: bool, off_road: bool) -> bool:
    """Return whether an episode is a success.

    It is none after a crash. Where the scene has a goal, `ms_highway.envs.road.goals.success` decides at the end of the
    episode; elsewhere, and in ``u-turn``, whose 191 m to the road back are more than its 10 s allow, the ego has stayed
    on the road in all frames.

    Args:
        env: the environment, unwrapped, after its last step.
        crashed: whether the ego has crashed.
        off_road: whether it has left the road in any frame.
    """
    reached = None if isinstance(env, UTurnEnv) else success(env)
    return not crashed and bool(not off_road if reached is None else reached)


def route_to_goal(env: Any) -> list[tuple[str, str, int | None]] | None:
    """Return the roads of the ego's way to the goal, without a lane where each will do; None without a destination.

    Args:
        env: the environment, unwrapped, after a reset.
    """
    if isinstance(env, ExitEnv):
        last = env.config["lanes_count"]
        return [("0", "1", last - 1), ("1", "2", last), ("2", "exit", 0)]
    destination = destination_of(env)
    if destination is None:
        return None
    start, onward, _ = env.vehicle.lane_index
    nodes = [start, *env.road.network.shortest_path(onward, destination)]
    return [(one, other, None) for one, other in pairwise(nodes)]
