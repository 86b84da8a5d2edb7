"""Say what a highway-env environment asks of its controlled car: where to go, how fast, and whether it is there."""

from typing import Any

from highway_env.envs import ExitEnv, IntersectionEnv, MergeEnv, RoundaboutEnv, UTurnEnv

DESTINATIONS = {RoundaboutEnv: "nxs", ExitEnv: "exit", UTurnEnv: "d"}
USUAL_SPEED = 30.0  # m/s
MERGED = 370.0  # m, where merge-v0 ends


def destination_of(env: Any, number: int = 0) -> str | None:
    """Return the node of the road network that a controlled vehicle has to reach; None without one.

    Args:
        env: a highway-env environment, or a wrapper of one, after a reset.
        number: of the controlled vehicle.
    """
    env = env.unwrapped
    if isinstance(env, IntersectionEnv):
        route = getattr(env.controlled_vehicles[number], "route", None) or []
        return route[-1][1] if len(route) > 1 else env.config["destination"] if number == 0 else None
    return next((node for kind, node in DESTINATIONS.items() if isinstance(env, kind)), None)


def desired_speed_of(env: Any) -> float:
    """Return the speed that a highway-env environment rewards most; in an intersection, the speed limit [m/s]."""
    config = env.unwrapped.config
    action = config["action"].get("action_config", config["action"])
    if isinstance(env.unwrapped, IntersectionEnv):  # which rewards no more than 9 m/s, but grants 13 s only
        return float(env.unwrapped.vehicle.lane.speed_limit)
    speeds = config.get("reward_speed_range") or action.get("target_speeds")
    speeds = [config.get("speed_limit") or USUAL_SPEED] if speeds is None else speeds
    return float(max(speeds))


def success(env: Any) -> bool | None:
    """Return whether the goal of a highway-env environment is reached now; None where it has no goal.

    exit: on the exit or its lane; intersection: every controlled car has arrived; roundabout: it has left the ring to
    the north; merge: it has passed the ramp; u-turn: it is on the road back. A car that has crashed has no success.
    """
    env = env.unwrapped
    vehicles, road = env.controlled_vehicles, env.vehicle.lane_index[:2]
    if isinstance(env, ExitEnv):
        there = env._is_success()
    elif isinstance(env, IntersectionEnv):
        there = all(env.has_arrived(vehicle) for vehicle in vehicles)
    elif isinstance(env, RoundaboutEnv):
        there = road in (("nx", "nxs"), ("nxs", "nxr"))
    elif isinstance(env, MergeEnv):
        there = env.vehicle.position[0] > getattr(env, "end_position", MERGED)
    elif isinstance(env, UTurnEnv):
        there = road == ("c", "d")
    else:
        return None
    return bool(there) and not any(vehicle.crashed for vehicle in vehicles)
