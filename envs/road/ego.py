"""Put another vehicle in the place of the one that a highway-env environment controls."""

from collections.abc import Callable, Iterator
from typing import Any

from highway_env.vehicle.graphics import VehicleGraphics
from highway_env.vehicle.kinematics import Vehicle

KEPT = ("color", "route", "target_speeds", "check_collisions", "collidable", "solid", "MIN_SPEED", "MAX_SPEED")
"""Attributes of a vehicle, beside its state, that its replacement keeps where the vehicle itself has them."""


def replace_ego(env: Any, make: Callable[[Vehicle], Vehicle], number: int = 0) -> Vehicle:
    """Replace a controlled vehicle by another at the same place, in the same state and with the same route.

    Args:
        env: a highway-env environment, or a wrapper of one, after a reset.
        make: builds the new vehicle from the old one.
        number: of the controlled vehicle.

    Returns:
        The new vehicle.
    """
    env = env.unwrapped
    old = env.controlled_vehicles[number]
    new = make(old)
    new.position, new.heading, new.speed = old.position.copy(), old.heading, old.speed
    new.crashed, new.impact = old.crashed, old.impact
    for name in vars(old).keys() & KEPT:
        setattr(new, name, getattr(old, name))
    if getattr(new, "color", None) is None:
        new.color = VehicleGraphics.EGO_COLOR
    new.on_state_update()
    env.controlled_vehicles[number] = new
    env.road.vehicles[env.road.vehicles.index(old)] = new
    alone = len(env.controlled_vehicles) == 1
    for part in (*_parts(env.action_type), *_parts(env.observation_type)):
        for name in ("controlled_vehicle", "observer_vehicle"):
            if hasattr(part, name) and (alone or getattr(part, name) is old):
                setattr(part, name, new)
    return new


def _parts(whole: Any) -> Iterator[Any]:
    """Yield an action or observation type, and those that it is made of."""
    yield whole
    for name in ("agents_action_types", "agents_observation_types", "observation_types"):
        for part in getattr(whole, name, ()):
            yield from _parts(part)
