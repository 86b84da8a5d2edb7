"""Predict drivers by their own motion alone: constant velocity, and constant turn rate and acceleration."""

from functools import partial

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.moments import STEPS, Moments
from ms_highway.irl.outlook import Modes

__all__ = ["WINDOW", "constant_velocity", "turn_and_accelerate"]

WINDOW = 3.0
"""Seconds of the past from which acceleration and turn rate are estimated."""

FADING = (0.5, 0.25)
"""Seconds, time constants with which acceleration and turn rate fade: those with the least error on NGSIM."""


def constant_velocity(moments: Moments) -> Modes:
    """Predict drivers who keep their speed and heading."""
    now = moments.drivers(moments.now)
    still = np.zeros(len(now))
    return _one_mode(_arc(now, still, still, *FADING))


def turn_and_accelerate(moments: Moments, fading: tuple[float, float] = FADING) -> Modes:
    """Predict drivers by constant turn rate and acceleration (CTRA).

    Both are slopes fitted by least squares to the `WINDOW` before, and 0 where less of it was recorded. Measured slopes
    are noisy and drivers soon correct them, so both fade exponentially.

    Args:
        moments: to predict.
        fading: time constants of acceleration and turn rate [s]; as they grow, the prediction becomes exact CTRA.
    """
    steps = round(WINDOW / TIME_STEP)
    past = moments.drivers(np.moveaxis(np.asarray(moments.past), 1, 2))[:, -steps - 1 :]
    times = TIME_STEP * (np.arange(steps + 1) - steps / 2)
    slopes = np.nan_to_num(np.einsum("t,ntc->nc", times, past[..., 2:]) / np.sum(times**2))
    return _one_mode(_arc(past[:, -1], slopes[:, 1], slopes[:, 0], *fading))


def _one_mode(path: Float[jax.Array, "n 50 2"]) -> Modes:
    return Modes(jnp.ones((len(path), 1)), path[:, None])


@jax.jit
@partial(jnp.vectorize, signature="(c),(),(),(),()->(t,d)")
def _arc(
    now: jax.Array, acceleration: jax.Array, turn_rate: jax.Array, acceleration_fades: jax.Array, turn_fades: jax.Array
) -> jax.Array:
    """Return positions [50, 2] after each step from a state, with a turn rate and an acceleration that fade."""
    x, y, heading, speed = now
    middles = TIME_STEP * (jnp.arange(STEPS) + 0.5)
    distance = TIME_STEP * jnp.maximum(speed + acceleration * _effect(middles, acceleration_fades), 0.0)
    direction = heading + turn_rate * _effect(middles, turn_fades)
    along, across = jnp.cumsum(distance * jnp.cos(direction)), jnp.cumsum(distance * jnp.sin(direction))
    return jnp.stack([x + along, y + across], axis=-1)


def _effect(times: jax.Array, fading: jax.Array) -> jax.Array:
    """Return the integral until each time of what begins at 1 and fades."""
    return -fading * jnp.expm1(-times / fading)
