"""Follow the car ahead by the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000)."""

from jax import numpy as jnp

from ms_highway.runtime.arrays import Numbers

FAR = 1e3
"""Distance to a car ahead that is not there [m]."""

COMFORTABLE, BRAKING, HEADWAY, STANDSTILL = 3.0, 5.0, 1.5, 10.0  # m/s^2, m/s^2, s, m between centres: highway-env's
HARDEST = 6.0  # m/s^2, of braking


def lowest(values: Numbers, where: Numbers) -> Numbers:
    """Return the lowest of values in the last axis of those that count, `FAR` where none does."""
    return jnp.where(where, values, FAR).min(axis=-1)


def highest(values: Numbers, where: Numbers) -> Numbers:
    """Return the highest of values in the last axis of those that count, minus `FAR` where none does."""
    return jnp.where(where, values, -FAR).max(axis=-1)


def idm_acceleration(
    speed: Numbers,
    wanted: float | Numbers,
    gap: Numbers,
    ahead: Numbers,
    headway: float | Numbers = HEADWAY,
    standstill: float = STANDSTILL,
) -> Numbers:
    """Return the acceleration of a follower, by default with highway-env's parameters.

    Args:
        speed: of the follower [m/s].
        wanted: its desired speed [m/s].
        gap: to the car ahead [m], `FAR` without one. It is that of centres in highway-env.
        ahead: speed of that car [m/s].
        headway: desired time gap [s].
        standstill: desired gap of standing cars, between bumpers or centres as the gap is [m].
    """
    closing = speed * (speed - ahead) / (2 * (COMFORTABLE * BRAKING) ** 0.5)
    desired = standstill + jnp.maximum(speed * headway + closing, 0.0)
    free = 1 - (speed / jnp.maximum(wanted, 0.1)) ** 4
    return jnp.clip(COMFORTABLE * (free - (desired / jnp.maximum(gap, 0.5)) ** 2), -HARDEST, COMFORTABLE)
