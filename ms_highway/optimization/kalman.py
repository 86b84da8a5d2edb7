"""Estimate what cannot be seen from noisy observations: the extended Kalman filter, one number observed at a time.

Vectors are [n, *batch] and matrices [n, n, *batch], so that XLA vectorises over the batch.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.runtime.arrays import Array


class Gaussian(NamedTuple):
    """Normal distributions of n variables.

    Attributes:
        mean: [n, *batch].
        covariance: [n, n, *batch].
    """

    mean: Array
    covariance: Array


def predicted(belief: Gaussian, transition: Array, noise: Array) -> Gaussian:
    """Return the distribution after a linear step, ``x <- F x, P <- F P F' + Q``."""
    covariance = product(product(transition, belief.covariance), jnp.swapaxes(transition, 0, 1))
    return Gaussian(apply(transition, belief.mean), covariance + noise)


def updated(
    belief: Gaussian, slope: Array, surprise: Array, variance: float | Array, most: float | None = None
) -> tuple[Gaussian, jax.Array]:
    """Return the distribution after an observation, and the observation's log density but for a constant.

    With the slope h of what is expected, ``s = h' P h + variance``, and the surprise clipped to as many standard
    deviations as count at most, where that is given::

        K = P h / s,    x <- x + K surprise,    P <- P - K h' P

    Args:
        belief: before.
        slope: of the expected observation in the variables [n, *batch].
        surprise: the observation less the expected one [*batch].
        variance: of the observation's noise.
        most: standard deviations that a surprise counts at most.
    """
    mean, covariance = belief
    along = apply(covariance, slope)
    total = jnp.sum(slope * along, axis=0) + variance
    density = -(surprise**2 / total + jnp.log(total)) / 2
    if most is not None:
        reach = most * jnp.sqrt(total)
        surprise = jnp.clip(surprise, -reach, reach)
    gain = along / total
    return Gaussian(mean + gain * surprise, covariance - gain[:, None] * along), density


def apply(matrix: Array, vector: Array) -> jax.Array:
    """Multiply matrices [i, j, *batch] by vectors [j, *batch]."""
    return jnp.sum(matrix * vector, axis=1)


def product(left: Array, right: Array) -> jax.Array:
    """Multiply matrices [i, j, *batch] by matrices [j, k, *batch]."""
    return jnp.sum(left[:, :, None] * right, axis=1)
