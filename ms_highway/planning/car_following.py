"""Follow the car ahead by the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000)."""

from jax import numpy as jnp

from ms_highway.geometry.curve import namespace
from ms_highway.runtime.arrays import Numbers

FREE_GAP = 1e3
"""Distance to a car ahead that is not there [m]."""

MAX_ACCELERATION, COMFORTABLE_BRAKING = 3.0, 5.0  # m/s^2, highway-env's
HEADWAY, STANDSTILL = 1.5, 10.0  # s, and m between centres, highway-env's
MAX_BRAKING = 6.0  # m/s^2, of braking


def lowest(values: Numbers, where: Numbers) -> Numbers:
    """Return the lowest of values in the last axis of those that count, `FREE_GAP` where none does."""
    return jnp.where(where, values, FREE_GAP).min(axis=-1)


def highest(values: Numbers, where: Numbers) -> Numbers:
    """Return the highest of values in the last axis of those that count, minus `FREE_GAP` where none does."""
    return jnp.where(where, values, -FREE_GAP).max(axis=-1)


def idm_acceleration(
    speed: Numbers,
    wanted: float | Numbers,
    gap: Numbers,
    ahead: Numbers,
    headway: float | Numbers = HEADWAY,
    standstill: float | Numbers = STANDSTILL,
    strongest: float | Numbers = MAX_ACCELERATION,
    braking: float | Numbers = COMFORTABLE_BRAKING,
) -> Numbers:
    """Return the acceleration of a follower, by default with highway-env's parameters; arrays of NumPy or JAX.

    The part of the desired gap that depends on speeds is at least 0, as in the paper; highway-env squares it where the
    follower is slower and it is negative.

    Args:
        speed: of the follower [m/s].
        wanted: its desired speed [m/s].
        gap: to the car ahead [m], `FREE_GAP` without one. It is that of centres in highway-env.
        ahead: speed of that car [m/s].
        headway: desired time gap [s].
        standstill: desired gap of standing cars, between bumpers or centres as the gap is [m].
        strongest: acceleration from standstill on a free road [m/s^2].
        braking: comfortable deceleration [m/s^2].
    """
    closing = speed * (speed - ahead) / (2 * (strongest * braking) ** 0.5)
    xp = namespace(speed, wanted, gap, ahead)
    desired = standstill + xp.maximum(speed * headway + closing, 0.0)
    free = 1 - (speed / xp.maximum(wanted, 0.1)) ** 4
    return xp.maximum(strongest * (free - (desired / xp.maximum(gap, 0.5)) ** 2), -MAX_BRAKING)
