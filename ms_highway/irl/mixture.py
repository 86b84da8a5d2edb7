"""Describe where drivers may be: mixtures of Student t distributions around paths."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.data.learned_drivers import Spread
from ms_highway.geometry.curve import namespace
from ms_highway.irl.snapshots import Paths
from ms_highway.numerics.estimation import Parameters, minimum
from ms_highway.runtime.arrays import Array, Scalar, plain

SIDES = np.array([0, -1, 1])
"""Number of lanes to the right by which a driver changes in each mode of the learned
drivers.
"""

Steps = Float[Array, "n 50"]  # a value after each step


@dataclass(frozen=True)
class SpreadFit:
    """Set how the spread around predictions is fitted."""

    stride: int = 5
    """Steps between those at which distributions are fitted: half a second."""
    first: tuple[float, ...] = (-0.7, 1.3, 0.0, -1.8, 0.9, 0.0, 0.0, 0.0, 1.0, 0.0)
    """Parameters that a fit starts from: three of the scale along the road, three of
    the scale across it, two of lane changes, the logarithm of the degrees of freedom
    after 1 s, and the power with which they grow; see `Spread`.
    """
    deviation: float = 2.0
    """Standard deviation of the parameters around these in the prior."""

    @property
    def times(self) -> slice:
        """The steps at which distributions are fitted."""
        return slice(self.stride - 1, None, self.stride)


SPREAD_FIT = SpreadFit()


class Modes(NamedTuple):
    """Paths that each of n drivers may take; in mode 0, the driver stays in its lane.

    Attributes:
        probability: of each mode.
        path: x and y after each step.
    """

    probability: Float[Array, "n modes"]
    path: Float[Array, "n modes 50 2"]


class Mixture(NamedTuple):
    """The predicted distribution of drivers' positions.

    Attributes:
        modes: paths of every driver, and their probabilities.
        spread: of the positions around the path of each mode.
    """

    modes: Modes
    spread: Spread


def expected_path(modes: Modes) -> Paths:
    """Return the mean of the modes' paths, from which errors are measured."""
    probability = np.asarray(modes.probability)
    path = np.asarray(modes.path)
    return np.einsum("nm,nmtc->ntc", probability, path)


@jax.jit
def log_density(mixture: Mixture, positions: Paths) -> Steps:
    """Return the log density of positions after each step [1/m^2].

    It is NaN where a position is NaN. With the scales s and t, the degrees of freedom
    nu and the deviations dx and dy, each mode has the bivariate Student t density::

        (1 + ((dx / s)^2 + (dy / t)^2) / nu)^-(nu / 2 + 1) / (2 pi s t)
    """
    modes, spread = mixture
    _, number, steps, _ = modes.path.shape
    scales = spread.scales(number, steps)  # [modes, steps, 2]
    freedom = spread.freedom(steps)

    # The log density of each mode [n, modes, steps].
    deviations = (positions[:, None] - modes.path) / scales
    squares = jnp.sum(deviations**2, axis=-1)
    power = -(freedom / 2 + 1)
    log_kernel = power * jnp.log1p(squares / freedom)
    log_area = jnp.sum(jnp.log(scales), axis=-1)  # log(s t)
    log_densities = log_kernel - jnp.log(2 * jnp.pi) - log_area

    # Their sum, weighted by the modes' probabilities.
    least_probability = 1e-9  # the logarithm of 0 is not finite
    probability = jnp.maximum(modes.probability, least_probability)
    log_weights = jnp.log(probability)[..., None]
    return jax.scipy.special.logsumexp(log_densities + log_weights, axis=1)


def density_level(mixture: Mixture, positions: Paths) -> Steps:
    """Estimate how much probability is denser than each position.

    This is the probability of the region of highest density that has the position on
    its edge, estimated by the share of 256 draws from the predicted distribution whose
    density is higher. If the predicted spread is right, levels are distributed
    uniformly: half of the drivers are in the 50 % region.
    """
    draws = 256
    # Heavy tails exceed floating-point numbers: bounds of a chi-square, and of a draw.
    least_square = 1e-30
    farthest = 1e9  # m

    (probability, paths), spread = mixture
    path = np.asarray(paths)
    drivers, modes, steps, _ = path.shape
    scales = np.asarray(spread.scales(modes, steps))
    freedom = np.asarray(spread.freedom(steps))
    density = np.asarray(log_density(mixture, positions))
    cumulative = np.cumsum(np.asarray(probability), axis=1)
    thresholds = cumulative[:, :-1]  # between modes

    random = np.random.default_rng(0)
    number_inside = np.zeros((drivers, steps))
    for _ in range(draws):
        # A mode for each driver, and a Student t variable for each step.
        is_beyond = random.random((drivers, 1)) > thresholds
        mode = np.sum(is_beyond, axis=1)
        chi_squares = random.chisquare(freedom, (drivers, steps))
        chi_squares = np.maximum(chi_squares, least_square)
        stretch = np.sqrt(freedom / chi_squares)[..., None]
        normal = random.normal(size=(drivers, steps, 2))
        path_of_mode = path[np.arange(drivers), mode]  # [drivers, steps, 2]
        drawn = path_of_mode + stretch * normal * scales[mode]

        # Whether the predicted density is higher there.
        drawn = np.clip(drawn, -farthest, farthest)
        number_inside += np.asarray(log_density(mixture, drawn)) > density
    share_inside = number_inside / draws
    return np.where(np.isfinite(density), share_inside, np.nan)


def fit_spread(modes: Modes, positions: Paths) -> Spread:
    """Fit the spread that makes recorded positions most likely, every half second."""
    is_known = np.all(np.isfinite(positions), axis=-1)
    known = is_known[:, SPREAD_FIT.times]
    without_nan = np.nan_to_num(positions)
    first = np.array(SPREAD_FIT.first)
    parameters = minimum(_loss, first, modes, without_nan, known)
    return plain(_spread_of(parameters))


def _spread_of(parameters: Parameters) -> Spread:
    """Return the spread with the parameters of `SpreadFit`, in their precision."""
    xp = namespace(parameters)
    freedom = xp.exp(parameters[8])
    growth = parameters[9]
    return Spread(
        along=parameters[:3],
        across=parameters[3:6],
        changing=parameters[6:8],
        tails=xp.stack([freedom, growth]),
    )


@jax.jit
@jax.value_and_grad
def _loss(
    parameters: Parameters,
    modes: Modes,
    positions: Paths,
    known: Bool[Array, "n times"],
) -> Scalar:
    """Return minus the mean log density of the known positions, with a weak prior."""
    mixture = Mixture(modes, _spread_of(parameters))
    log_densities = log_density(mixture, positions)
    densities = log_densities[:, SPREAD_FIT.times]
    deviations = parameters - jnp.array(SPREAD_FIT.first)
    prior = jnp.sum(deviations**2) / (2 * SPREAD_FIT.deviation**2)

    # Every horizon has the same weight, though fewer drivers are seen for long.
    seen = jnp.maximum(known.sum(axis=0), 1)
    prior_share = prior / known.sum()
    means = jnp.where(known, densities, 0.0).sum(axis=0) / seen
    return prior_share - jnp.mean(means)
