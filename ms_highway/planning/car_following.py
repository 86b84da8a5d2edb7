"""Follow the car ahead by the Intelligent Driver Model (Treiber, Hennecke and Helbing 2000)."""

from jax import numpy as jnp

from ms_highway.geometry.curve import namespace
from ms_highway.runtime.arrays import Numbers

FREE_GAP = 1e3
"""Distance to the car ahead if there is none [m]."""

MAX_ACCELERATION, COMFORTABLE_BRAKING = 3.0, 5.0  # m/s^2, highway-env's
HEADWAY, STANDSTILL = 1.5, 10.0  # s, and m between centres, highway-env's
MAX_BRAKING = 6.0  # m/s^2


def lowest(values: Numbers, where: Numbers) -> Numbers:
    """Return the lowest of the values that count in the last axis, `FREE_GAP` where none counts."""
    return jnp.where(where, values, FREE_GAP).min(axis=-1)


def highest(values: Numbers, where: Numbers) -> Numbers:
    """Return the highest of the values that count in the last axis, minus `FREE_GAP` where none counts."""
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

    The part of the desired gap that depends on speeds is at least 0, as in the paper; in highway-env it may be negative
    behind a faster car.

    Args:
        speed: of the follower [m/s].
        wanted: its desired speed [m/s].
        gap: to the car ahead [m], between centres in highway-env; `FREE_GAP` without one.
        ahead: speed of that car [m/s].
        headway: desired time gap [s].
        standstill: desired gap between standing cars, measured like the gap [m].
        strongest: acceleration from standstill on a free road [m/s^2].
        braking: comfortable deceleration [m/s^2].
    """
    closing = speed * (speed - ahead) / (2 * (strongest * braking) ** 0.5)
    xp = namespace(speed, wanted, gap, ahead)
    desired = standstill + xp.maximum(speed * headway + closing, 0.0)
    free = 1 - (speed / xp.maximum(wanted, 0.1)) ** 4
    return xp.maximum(strongest * (free - (desired / xp.maximum(gap, 0.5)) ** 2), -MAX_BRAKING)
