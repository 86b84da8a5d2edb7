"""Maximum-entropy inverse reinforcement learning: the reward that makes recorded driving likely.

A driver is modelled as drawing the controls u of a segment, in the planner's scaled units, from

    p(u) = exp(R(u) / T) / integral of exp(R(u') / T) du',    R(u) = theta . phi(u)

with the features along the segment, comfort among them, and the other cars moving as recorded. Laplace's
approximation of the integral around what the driver did gives, with the gradient g and the Hessian H of R / T there
(Levine and Koltun 2012, Eq. 4),

    log p(u) = g^T H^-1 g / 2 + log det(-H) / 2 - (d / 2) log 2 pi

The first term is large if the driver was near an optimum, the second if that optimum is sharp. g and H are linear in
theta: the features' derivatives are computed once, and a fit then takes seconds.

Real drivers are mostly near an optimum, and now and then far from it. Their temperature varies from segment to segment,
T times an inverse-gamma variable of ``nu / 2`` and ``nu / 2``, which makes p a multivariate Student t distribution with
nu degrees of freedom, its *tails*::

    log p(u) = -(nu + d) / 2 log(1 - g^T H^-1 g / nu) + log det(-H) / 2
               + log Gamma((nu + d) / 2) - log Gamma(nu / 2) - (d / 2) log(nu pi)
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jax.scipy.special import gammaln
from jaxtyping import Float
from scipy import optimize

from ms_highway.game.game import Game
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.game.reward import COMFORT, RewardModel
from ms_highway.irl.recording import Flags, Numbers
from ms_highway.irl.segments import Segments, driver_game, summed_features
from ms_highway.numerics.estimation import Parameters, grouped_covariance, slope_differences
from ms_highway.numerics.second_derivatives import floored
from ms_highway.runtime.arrays import Scalar, Vector
from ms_highway.runtime.compilation import in_batches, jit_quickly
from ms_highway.runtime.jax_settings import double_precision

PRIOR_SPREAD = 4.0  # standard deviation of log |theta| and log T around 0: weak, two of it are a factor of 3000
DIFFERENCE = 1e-4  # of log theta, for the Hessian of the log-likelihood
TOLERANCE = 1e-3  # of the slope of the objective per segment, in a fit that has converged
TRUST_REGION = {"gtol": TOLERANCE / 10, "initial_trust_radius": 1.0, "max_trust_radius": 3.0, "maxiter": 200}


class FeatureDerivatives(NamedTuple):
    """The features' derivatives in the d scaled controls of n segments, at the recorded controls.

    Attributes:
        features: phi, summed along each segment.
        gradients: first derivatives.
        hessians: second derivatives.
    """

    features: Float[Any, "n names"]
    gradients: Float[Any, "n names d"]
    hessians: Float[Any, "n names d d"]

    def of(self, chosen: Flags) -> "FeatureDerivatives":
        """Return the derivatives in the chosen segments."""
        return FeatureDerivatives(*(part[chosen] for part in self))


@dataclass(frozen=True)
class Fit:
    """Weights and temperature that were fitted.

    Attributes:
        model: the weights that were learned and those given.
        logarithms: of the learned weights' sizes, of the temperature T and, in a model with tails, of nu.
        covariance: of the logarithms: the inverse of minus the Hessian of the log-likelihood and prior; if drivers are
            given, `grouped_covariance`, as the segments of one driver are not independent.
        iterations: of the optimiser.
        log_likelihood: mean over the segments.
        weights: all of them, by name.
        temperature: T, the spread of the drivers around the optimum, in units of the reward.
        tails: degrees of freedom nu, None for a normal distribution.
    """

    model: RewardModel
    logarithms: Parameters
    covariance: Float[Any, "parameters parameters"]
    iterations: int
    log_likelihood: float
    weights: dict[str, float]
    temperature: float
    tails: float | None


def differentiate(segments: Segments, names: tuple[str, ...]) -> FeatureDerivatives:
    """Return the derivatives of these features in every segment.

    Raises:
        ValueError: if a derivative is not finite.
    """
    game = driver_game(segments, {}, names)
    columns = np.array([(*game.robot.names, *COMFORT).index(name) for name in names])
    parts = in_batches(lambda batch: [part[:, columns] for part in _differentiate(game, batch)], segments)
    derivatives = FeatureDerivatives(*(part.astype(np.float64) for part in parts))
    sums = [part.reshape(len(segments), -1).sum(axis=1) for part in derivatives]
    for segment in np.flatnonzero(~np.isfinite(sum(sums))):
        start = segments.start[segment]
        raise ValueError(f"the features of segment {segment} have no finite derivatives; it starts at {start}")
    return derivatives


@jit_quickly
@partial(jax.vmap, in_axes=(None, 0))
def _differentiate(game: Game, segment: Segments) -> FeatureDerivatives:
    """Return the derivatives of all features and of `COMFORT`, so that one compilation serves any choice of them."""

    def along(controls: jax.Array) -> jax.Array:
        return summed_features(game, segment, controls.reshape(-1, 2))

    controls, slope = (segment.controls / game.planner.control_scale).ravel(), jax.jacrev(along)
    return FeatureDerivatives(along(controls), slope(controls), jax.jacfwd(slope)(controls))


@jax.jit
def log_likelihoods(
    derivatives: FeatureDerivatives,
    theta: Vector,
    temperature: float | Scalar,
    floor: float,
    tails: float | Scalar | None = None,
) -> Vector:
    """Return Laplace's log p of the scaled controls in every segment; eigenvalues of -H are at least ``floor / T``.

    Args:
        derivatives: of the features in every segment.
        theta: weights of these features.
        temperature: T.
        floor: least curvature of -R.
        tails: nu, None for a normal distribution.
    """

    def segment(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
        slope, bend = pair
        lowest, d = floor / temperature, len(slope)
        high = jnp.isfinite(jnp.linalg.cholesky(bend - lowest * jnp.eye(d))).all()  # then nothing is floored
        root = jnp.linalg.cholesky(jax.lax.cond(high, lambda bend: bend, lambda bend: floored(bend, lowest), bend))
        off, sharp = slope @ cho_solve((root, True), slope), jnp.sum(jnp.log(jnp.diagonal(root)))
        if tails is None:
            return -off / 2 + sharp - d / 2 * jnp.log(2 * jnp.pi)
        normalised = gammaln((tails + d) / 2) - gammaln(tails / 2) - d / 2 * jnp.log(tails * jnp.pi)
        return normalised + sharp - (tails + d) / 2 * jnp.log1p(off / tails)

    slope = jnp.einsum("f,nfd->nd", theta, derivatives.gradients) / temperature
    bend = -jnp.einsum("f,nfde->nde", theta, derivatives.hessians) / temperature
    return jax.lax.map(segment, (slope, bend))


def segment_log_likelihoods(derivatives: FeatureDerivatives, found: Fit | LearnedReward) -> Vector:
    """Return `log_likelihoods` of the scaled controls in every segment under a reward, in double precision."""
    with double_precision():
        theta = jnp.array([found.weights[name] for name in found.model.names])
        data = FeatureDerivatives(*map(jnp.asarray, derivatives))
        return np.asarray(log_likelihoods(data, theta, found.temperature, found.model.floor, found.tails))


def fit_weights(
    derivatives: FeatureDerivatives,
    model: RewardModel,
    near: Fit | None = None,
    drivers: Numbers | None = None,
) -> Fit:
    """Fit the weights and the temperature that make segments most likely under a weak prior, in double precision.

    The logarithms of the weights' sizes and of the temperature have independent normal priors with mean 0 and standard
    deviation 4. Where the segments carry no information about a weight, its prior remains, and the covariance shows it.

    Args:
        derivatives: of the features `RewardModel.names`, in their order.
        model: the weights to learn and those given.
        near: a fit to start from.
        drivers: number of each segment's driver, for the covariance; by default, all segments are independent.

    Raises:
        ValueError: if the weights diverge, or the fit does not converge.
    """
    number, learned = len(derivatives.features), len(model.learned)
    remedy = "learn fewer weights, or from more driving"
    with double_precision():
        given = jnp.array([float(value) for value in model.given.values()])
        data = FeatureDerivatives(*map(jnp.asarray, derivatives)), model.floor, model.signs(), given

        def loss(logarithms: Parameters) -> tuple[float, np.ndarray]:
            (value, _), slope = _loss(logarithms, *data)
            return float(value), np.asarray(slope)

        def bend(logarithms: Parameters) -> np.ndarray:
            hessian = slope_differences(lambda near: loss(near)[1], logarithms, DIFFERENCE)
            if not np.isfinite(hessian).all():
                raise ValueError(f"the weights diverge, at {model.weights(logarithms)}; {remedy}")
            return hessian

        first = np.zeros(learned + 1 + model.tails) if near is None else near.logarithms
        found = optimize.minimize(loss, first, jac=True, hess=bend, method="trust-exact", options=TRUST_REGION)
        top, weights, hessian = np.asarray(found.x), model.weights(found.x), bend(found.x)
        if np.abs(loss(top)[1]).max() >= TOLERANCE:
            raise ValueError(f"the fit has not converged after {found.nit} iterations, at {weights}; {remedy}")
        covariance = np.linalg.pinv(number * (hessian + hessian.T) / 2, hermitian=True)
        if drivers is not None:
            covariance = grouped_covariance(covariance, np.asarray(_segment_scores(top, *data)), drivers)
        likely = float(_loss(top, *data)[0][1].mean())
    temperature, *tails = np.exp(top[learned:]).tolist()
    return Fit(model, top, covariance, int(found.nit), likely, weights, temperature, *(tails or [None]))


def _segment_likelihoods(
    logarithms: Parameters, derivatives: FeatureDerivatives, floor: float, signs: Parameters, given: Parameters
) -> Vector:
    """Return log p of every segment under logarithms of the learned weights' sizes, the temperature and perhaps nu."""
    sizes, learned = jnp.exp(logarithms), len(signs)
    temperature, *tails = sizes[learned:]
    return log_likelihoods(derivatives, jnp.concatenate([signs * sizes[:learned], given]), temperature, floor, *tails)


@jit_quickly
@partial(jax.value_and_grad, has_aux=True)
def _loss(logarithms: Parameters, *data: Any) -> tuple[Scalar, Vector]:
    """Return minus the mean log p under the prior, and log p of each segment."""
    each = _segment_likelihoods(logarithms, *data)
    return jnp.sum(logarithms**2) / (2 * PRIOR_SPREAD**2 * len(each)) - jnp.mean(each), each


_segment_scores = jit_quickly(jax.jacfwd(_segment_likelihoods))  # slopes of log p of each segment [n, parameters]
