"""Estimate variables from noisy observations by the extended Kalman filter.

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


def updated(
    belief: Gaussian, slope: Vector, surprise: Scalars, variance: Scalars, most: float | None = None
) -> tuple[Gaussian, Scalars]:
    """Return the distribution after an observation, and the observation's log density up to a constant.

    With the slope h of the expected observation, ``s = h' P h + variance``, and the surprise clipped to ``most``
    standard deviations, where that is given::

        K = P h / s,    x <- x + K surprise,    P <- P - K h' P

    Args:
        belief: before.
        slope: of the expected observation in the variables [n, *batch].
        surprise: the observation less the expected one [*batch].
        variance: of the observation's noise.
        most: standard deviations that a surprise counts at most.
    """
    mean, covariance = belief
    along = jnp.sum(covariance * slope, axis=1)
    total = jnp.sum(slope * along, axis=0) + variance
    density = -(surprise**2 / total + jnp.log(total)) / 2
    if most is not None:
        reach = most * jnp.sqrt(total)
        surprise = jnp.clip(surprise, -reach, reach)
    gain = along / total
    return Gaussian(mean + gain * surprise, covariance - gain[:, None] * along), density
