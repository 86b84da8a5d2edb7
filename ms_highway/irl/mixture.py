"""Predicted distributions of drivers' positions: mixtures of Student t distributions
around the paths of modes.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.data.learned_drivers import Spread
from ms_highway.irl.snapshots import Paths
from ms_highway.numerics.estimation import Parameters, minimum
from ms_highway.runtime.arrays import Scalar, plain

DRAWS = 256
"""Number of draws from a predicted distribution by which `density_level` is estimated.
"""

LEAST, FARTHEST = (
    1e-30,
    1e9,
)  # of a chi-square, and of a draw [m]: heavy tails exceed floating-point numbers

SIDES = np.array([0, -1, 1])
"""Number of lanes to the right by which a driver changes in each mode of the learned
drivers.
"""

EVERY = 5  # steps between those at which distributions are fitted
FIRST = (
    -0.7,
    1.3,
    0.0,
    -1.8,
    0.9,
    0.0,
    0.0,
    0.0,
    1.0,
    0.0,
)  # parameters that a fit starts from, the tails' last
PRIOR = 2.0  # standard deviation of the parameters around these

Steps = Float[Any, "n 50"]  # a value after each step


class Modes(NamedTuple):
    """Paths that each of n drivers may take; in mode 0, the driver stays in its lane.

    Attributes:
        probability: of each mode.
        path: x and y after each step.
    """

    probability: Float[Any, "n modes"]
    path: Float[Any, "n modes 50 2"]


class Mixture(NamedTuple):
    """The predicted distribution of drivers' positions.

    Attributes:
        modes: paths of every driver, and their probabilities.
        spread: of the positions around the path of each mode.
    """

    modes: Modes
    spread: Spread


def expected_path(modes: Modes) -> Paths:
    """Return the mean of the modes' paths, the single path from which errors are
    measured.
    """
    return np.einsum(
        "nm,nmtc->ntc", np.asarray(modes.probability), np.asarray(modes.path)
    )


@jax.jit
def log_density(mixture: Mixture, positions: Paths) -> Steps:
    """Return the log density of positions after each step [1/m^2]; NaN where a position
    is NaN.
    """
    modes, spread = mixture
    scales = spread.scales(*modes.path.shape[1:3])
    freedom = spread.freedom(modes.path.shape[2])
    deviations = (positions[:, None] - modes.path) / scales
    densities = -(freedom / 2 + 1) * jnp.log1p(
        jnp.sum(deviations**2, axis=-1) / freedom
    )
    densities = densities - jnp.log(2 * jnp.pi) - jnp.sum(jnp.log(scales), axis=-1)
    probabilities = jnp.log(jnp.maximum(modes.probability, 1e-9))
    return jax.scipy.special.logsumexp(densities + probabilities[..., None], axis=1)


def density_level(mixture: Mixture, positions: Paths) -> Steps:
    """Estimate the probability of the region of highest density that has each position
    on its edge, by `DRAWS` draws.

    If the predicted spread is right, levels are distributed uniformly: half of the
    drivers are in the 50 % region.
    """
    (probability, paths), spread = mixture
    random = np.random.default_rng(0)
    path = np.asarray(paths)
    n, number, steps = path.shape[:3]
    scales = np.asarray(spread.scales(number, steps))
    freedom = np.asarray(spread.freedom(steps))
    edge = np.asarray(log_density(mixture, positions))
    inside = np.zeros((n, steps))
    below = np.cumsum(np.asarray(probability), axis=1)[:, :-1]
    for _ in range(DRAWS):
        mode = np.sum(random.random((n, 1)) > below, axis=1)
        squares = np.maximum(random.chisquare(freedom, (n, steps)), LEAST)
        stretch = np.sqrt(freedom / squares)[..., None]
        drawn = (
            path[np.arange(n), mode]
            + stretch * random.normal(size=(n, steps, 2)) * scales[mode]
        )
        inside += (
            np.asarray(log_density(mixture, np.clip(drawn, -FARTHEST, FARTHEST))) > edge
        )
    return np.where(np.isfinite(edge), inside / DRAWS, np.nan)


def fit_spread(modes: Modes, positions: Paths) -> Spread:
    """Fit the spread that makes recorded positions most likely, every half second."""
    known = np.isfinite(positions).all(axis=-1)[:, EVERY - 1 :: EVERY]
    return plain(
        _spread_of(
            minimum(_loss, np.array(FIRST), modes, np.nan_to_num(positions), known)
        )
    )


def _spread_of(parameters: Parameters) -> Spread:
    xp = parameters.__array_namespace__()
    return Spread(
        parameters[:3],
        parameters[3:6],
        parameters[6:8],
        xp.stack([xp.exp(parameters[8]), parameters[9]]),
    )


@jax.jit
@jax.value_and_grad
def _loss(
    parameters: Parameters, modes: Modes, positions: Paths, known: Steps
) -> Scalar:
    """Return minus the mean log density of the known positions, with a weak prior."""
    densities = log_density(Mixture(modes, _spread_of(parameters)), positions)[
        :, EVERY - 1 :: EVERY
    ]
    prior = jnp.sum((parameters - jnp.array(FIRST)) ** 2) / (2 * PRIOR**2)
    seen = jnp.maximum(
        known.sum(axis=0), 1
    )  # every horizon has the same weight, though fewer are seen for long
    return prior / known.sum() - jnp.mean(
        jnp.where(known, densities, 0.0).sum(axis=0) / seen
    )
