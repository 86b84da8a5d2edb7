"""Estimate what cannot be seen from noisy observations: the extended Kalman filter, one number observed at a time.

Vectors are [n, *batch] and matrices [n, n, *batch], so that XLA vectorises over the batch.
"""

from typing import Any, NamedTuple

from jax import numpy as jnp
from jaxtyping import Float

Scalars = Float[Any, "*batch"]
Vector = Float[Any, "n *batch"]
Matrix = Float[Any, "n n *batch"]


class Gaussian(NamedTuple):
    """Normal distributions of n variables.

    Attributes:
        mean: [n, *batch].
        covariance: [n, n, *batch].
    """

    mean: Vector
    covariance: Matrix


def predicted(belief: Gaussian, transition: Matrix, noise: Matrix) -> Gaussian:
    """Return the distribution after a linear step, ``x <- F x, P <- F P F' + Q``."""
    covariance = product(product(transition, belief.covariance), jnp.swapaxes(transition, 0, 1))
    return Gaussian(apply(transition, belief.mean), covariance + noise)


def updated(
    belief: Gaussian, slope: Vector | int, surprise: Scalars, variance: Scalars, most: float | None = None
) -> tuple[Gaussian, Scalars]:
    """Return the distribution after an observation, and the observation's log density but for a constant.

    With the slope h of what is expected, ``s = h' P h + variance``, and the surprise clipped to as many standard
    deviations as count at most, where that is given::

        K = P h / s,    x <- x + K surprise,    P <- P - K h' P

    Args:
        belief: before.
        slope: of the expected observation in the variables [n, *batch]; or the number of the variable that is observed.
        surprise: the observation less the expected one [*batch].
        variance: of the observation's noise.
        most: standard deviations that a surprise counts at most.
    """
    mean, covariance = belief
    if isinstance(slope, int):
        along = covariance[:, slope]
        total = along[slope] + variance
    else:
        along = apply(covariance, slope)
        total = jnp.sum(slope * along, axis=0) + variance
    density = -(surprise**2 / total + jnp.log(total)) / 2
    if most is not None:
        reach = most * jnp.sqrt(total)
        surprise = jnp.clip(surprise, -reach, reach)
    gain = along / total
    return Gaussian(mean + gain * surprise, covariance - gain[:, None] * along), density


def mixed(belief: Gaussian, weights: Matrix) -> Gaussian:
    """Return the normal distributions with the moments of mixtures of those along the first axis of the batch.

    Args:
        belief: [n, from, *batch].
        weights: of each distribution in each mixture [from, to, *batch].
    """
    mean = jnp.sum(weights * belief.mean[:, :, None], axis=1)
    off = belief.mean[:, :, None] - mean[:, None]
    return Gaussian(mean, jnp.sum(weights * (belief.covariance[:, :, :, None] + off[:, None] * off), axis=2))


def apply(matrix: Matrix, vector: Vector) -> Vector:
    """Multiply matrices [i, j, *batch] by vectors [j, *batch]."""
    return jnp.sum(matrix * vector, axis=1)


def product(left: Matrix, right: Matrix) -> Matrix:
    """Multiply matrices [i, j, *batch] by matrices [j, k, *batch]."""
    return jnp.sum(left[:, :, None] * right, axis=1)
