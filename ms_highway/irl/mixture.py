"""Predicted distributions of drivers' positions: mixtures of Student t distributions around the paths of modes."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.learned_drivers import Spread
from ms_highway.irl.snapshots import Paths
from ms_highway.numerics.estimation import Parameters, minimum
from ms_highway.runtime.arrays import Scalar
from ms_highway.runtime.structures import plain

DRAWS = 256
"""Draws from a predicted distribution, by which `density_level` is estimated."""

LEAST, FARTHEST = 1e-30, 1e9  # of a chi-square, and m, of a draw: tails may be heavier than numbers hold

SIDES = np.array([0, -1, 1])
"""Lanes to the right by which a driver changes in each mode of the learned drivers."""

EVERY = 5
"""Steps between those at which distributions are fitted."""

FIRST = (-0.7, 1.3, 0.0, -1.8, 0.9, 0.0, 0.0, 0.0, 1.0, 0.0)  # parameters that a fit starts from, the tails' last
PRIOR = 2.0  # standard deviation of the parameters around these

Steps = Float[Any, "n 50"]  # a value after each step


class Modes(NamedTuple):
    """Paths that each of n drivers may take; in mode 0, it stays in its lane.

    Attributes:
        probability: of each mode.
        path: x and y after each step.
    """

    probability: Float[Any, "n modes"]
    path: Float[Any, "n modes 50 2"]


class Mixture(NamedTuple):
    """The predicted distribution of drivers' positions.

    Attributes:
        modes: of every driver.
        spread: of the distributions around the paths of the modes.
    """

    modes: Modes
    spread: Spread


def expected_path(modes: Modes) -> Paths:
    """Return the mean of the modes' paths, the single path that errors are measured by."""
    return np.einsum("nm,nmtc->ntc", np.asarray(modes.probability), np.asarray(modes.path))


@jax.jit
def log_density(mixture: Mixture, positions: Paths) -> Steps:
    """Return the log density of positions after each step [1/m^2]; NaN where a position is NaN."""
    modes, spread = mixture
    scales = spread.scales(*modes.path.shape[1:3])
    off = (positions[:, None] - modes.path) / scales
    freedom = spread.freedom(modes.path.shape[2])
    each = -(freedom / 2 + 1) * jnp.log1p(jnp.sum(off**2, axis=-1) / freedom)
    each = each - jnp.log(2 * jnp.pi) - jnp.sum(jnp.log(scales), axis=-1)
    chances = jnp.log(jnp.maximum(modes.probability, 1e-9))
    return jax.scipy.special.logsumexp(each + chances[..., None], axis=1)


def density_level(mixture: Mixture, positions: Paths) -> Steps:
    """Return the probability of the region of highest density that has each position on its edge, by `DRAWS` draws.

    Over cases that are predicted with the right spread, it is uniformly distributed: half of the drivers are in the
    50 % region.
    """
    (probability, paths), spread = mixture
    random, path = np.random.default_rng(0), np.asarray(paths)
    n, number, steps = path.shape[:3]
    scales, freedom = np.asarray(spread.scales(number, steps)), np.asarray(spread.freedom(steps))
    edge, inside = np.asarray(log_density(mixture, positions)), np.zeros((n, steps))
    below = np.cumsum(np.asarray(probability), axis=1)[:, :-1]
    for _ in range(DRAWS):
        mode = np.sum(random.random((n, 1)) > below, axis=1)
        squares = np.maximum(random.chisquare(freedom, (n, steps)), LEAST)
        stretch = np.sqrt(freedom / squares)[..., None]
        drawn = path[np.arange(n), mode] + stretch * random.normal(size=(n, steps, 2)) * scales[mode]
        inside += np.asarray(log_density(mixture, np.clip(drawn, -FARTHEST, FARTHEST))) > edge
    return np.where(np.isfinite(edge), inside / DRAWS, np.nan)


def fit_spread(modes: Modes, positions: Paths) -> Spread:
    """Fit the spread that makes recorded positions most likely, every half second."""
    known = np.isfinite(positions).all(axis=-1)[:, EVERY - 1 :: EVERY]
    found = minimum(_negative_log_density, np.array(FIRST), modes, np.nan_to_num(positions), known)
    return plain(_spread_of(found))


def _spread_of(parameters: Parameters) -> Spread:
    xp = parameters.__array_namespace__()
    return Spread(parameters[:3], parameters[3:6], parameters[6:8], xp.stack([xp.exp(parameters[8]), parameters[9]]))


@jax.jit
@jax.value_and_grad
def _negative_log_density(parameters: Parameters, modes: Modes, positions: Paths, known: Steps) -> Scalar:
    """Return minus the mean log density of the known positions, with a weak prior."""
    spread = _spread_of(parameters)
    each = log_density(Mixture(modes, spread), positions)[:, EVERY - 1 :: EVERY]
    weak = jnp.sum((parameters - jnp.array(FIRST)) ** 2) / (2 * PRIOR**2)
    seen = jnp.maximum(known.sum(axis=0), 1)  # every horizon counts alike, though fewer are seen for long
    return weak / known.sum() - jnp.mean(jnp.where(known, each, 0.0).sum(axis=0) / seen)
