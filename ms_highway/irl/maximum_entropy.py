"""Maximum-entropy inverse reinforcement learning: the reward that makes recorded driving likely.

The model: a driver draws the d controls u of a segment, in the planner's scaled units, from

    p(u) = exp(R(u) / T) / integral of exp(R(u') / T) du',    R(u) = theta . phi(u)

where phi sums the features along the segment, comfort among them, while the other cars move as recorded. Let g and H
be the gradient and the Hessian of R / T at the recorded controls. Laplace's approximation of the integral around these
controls gives (Levine and Koltun 2012, Eq. 4)

    log p(u) = g^T H^-1 g / 2 + log det(-H) / 2 - (d / 2) log 2 pi

The first term is large if the driver was near an optimum, the second if that optimum is sharp. g and H are linear in
theta: the features' derivatives are computed once, and a fit then takes seconds.

Real drivers are mostly near an optimum, and now and then far from it. Their temperature therefore varies from segment
to segment: it is T times an inverse-gamma variable with both parameters ``nu / 2``. This makes p a multivariate
Student t distribution with nu degrees of freedom, called its *tails*::

    log p(u) = -(nu + d) / 2 log(1 - g^T H^-1 g / nu) + log det(-H) / 2
               + log Gamma((nu + d) / 2) - log Gamma(nu / 2) - (d / 2) log(nu pi)
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jax.scipy.special import gammaln
from jaxtyping import Float
from scipy import optimize

from ms_highway.game.game import Game
from ms_highway.game.reward import COMFORT, RewardModel
from ms_highway.irl.recording import Numbers, Rows
from ms_highway.irl.segments import Segments, driver_game, summed_features
from ms_highway.numerics.estimation import (
    Parameters,
    grouped_covariance,
    slope_differences,
)
from ms_highway.numerics.second_derivatives import floored
from ms_highway.runtime.arrays import Scalar, Vector
from ms_highway.runtime.compilation import in_batches, jit_quickly
from ms_highway.runtime.jax_settings import double_precision

# standard deviation of log |theta| and log T around 0: weak, as two of them are a
# factor of 3000
PRIOR_SPREAD = 4.0
DIFFERENCE = 1e-4  # of log theta, for the Hessian of the log-likelihood
TOLERANCE = (
    1e-3  # largest slope of the loss, in any logarithm, of a fit that has converged
)
LARGEST = (
    5 * PRIOR_SPREAD
)  # size of a logarithm beyond which a weight or the temperature diverges: a factor of 5e8
TRUST_REGION = {
    "gtol": TOLERANCE / 10,
    "initial_trust_radius": 1.0,
    "max_trust_radius": 3.0,
    "maxiter": 200,
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FeatureDerivatives(Rows):
    """The features of n segments and their derivatives in the d scaled controls, at the
    recorded controls.

    Attributes:
        features: phi, summed along each segment.
        gradients: first derivatives.
        hessians: second derivatives.
    """

    features: Float[Any, "n names"]
    gradients: Float[Any, "n names d"]
    hessians: Float[Any, "n names d d"]


class DivergenceError(ValueError):
    """The likelihood has no maximum.

    Attributes:
        what: which weights grow, and whether the temperature grows or falls, without
            bound.
        likeliest: number of the segment whose likelihood grows most.
    """

    def __init__(self, what: str, likeliest: int) -> None:
        self.what = what
        self.likeliest = likeliest
        super().__init__(
            f"the weights cannot be learned: {what} without bound, because some driving"
            " fits them perfectly; learn fewer weights, or from more driving"
        )


@dataclass(frozen=True)
class Fit:
    """The result of a fit.

    Attributes:
        model: the weights that were learned and those given.
        logarithms: of the learned weights' sizes, of the temperature T and, in a model
            with tails, of nu.
        covariance: of the logarithms: the inverse of minus the Hessian of the
            log-likelihood and prior; if drivers are given, `grouped_covariance`, as the
            segments of one driver are not independent.
        iterations: of the optimiser.
        log_likelihood: mean over the segments.
        weights: all of them, by name.
        temperature: T, the spread of the drivers around the optimum, in units of the
            reward.
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
    found = in_batches(partial(_differentiate, game), segments)
    derivatives = jax.tree.map(lambda part: part[:, columns].astype(float), found)
    sums = sum(
        part.sum(axis=tuple(range(1, part.ndim)))
        for part in jax.tree.leaves(derivatives)
    )
    if not np.isfinite(sums).all():
        segment = np.isfinite(sums).argmin()
        start = segments.start[segment]
        raise ValueError(
            f"the features of segment {segment} have no finite derivatives; it starts"
            f" at {start}"
        )
    return derivatives


@jit_quickly
@partial(jax.vmap, in_axes=(None, 0))
def _differentiate(game: Game, segment: Segments) -> FeatureDerivatives:
    """Return the derivatives of all features and of `COMFORT`, so that one compilation
    serves any choice of them.
    """

    def features(controls: jax.Array) -> jax.Array:
        return summed_features(game, segment, controls.reshape(-1, 2))

    controls = (segment.controls / game.planner.control_scale).ravel()
    gradients = jax.jacrev(features)
    return FeatureDerivatives(
        features(controls), gradients(controls), jax.jacfwd(gradients)(controls)
    )


@jax.jit
def log_likelihoods(
    derivatives: FeatureDerivatives,
    theta: Vector,
    temperature: float | Scalar,
    floor: float,
    tails: float | Scalar | None = None,
) -> Vector:
    """Return Laplace's log p of the scaled controls in every segment; eigenvalues of -H
    are at least ``floor / T``.

    Args:
        derivatives: of the features in every segment.
        theta: weights of these features.
        temperature: T.
        floor: least curvature of -R.
        tails: nu, None for a normal distribution.
    """

    def log_p(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
        gradient, curvature = pair  # g and -H
        lowest = floor / temperature
        d = len(gradient)
        high = jnp.isfinite(
            jnp.linalg.cholesky(curvature - lowest * jnp.eye(d))
        ).all()  # then nothing is floored
        root = jnp.linalg.cholesky(
            jax.lax.cond(
                high, lambda same: same, lambda low: floored(low, lowest), curvature
            )
        )
        distance = gradient @ cho_solve((root, True), gradient)
        sharpness = jnp.sum(jnp.log(jnp.diagonal(root)))
        if tails is None:
            return -distance / 2 + sharpness - d / 2 * jnp.log(2 * jnp.pi)
        normalised = (
            gammaln((tails + d) / 2)
            - gammaln(tails / 2)
            - d / 2 * jnp.log(tails * jnp.pi)
        )
        return normalised + sharpness - (tails + d) / 2 * jnp.log1p(distance / tails)

    gradients = jnp.einsum("f,nfd->nd", theta, derivatives.gradients) / temperature
    curvatures = -jnp.einsum("f,nfde->nde", theta, derivatives.hessians) / temperature
    return jax.lax.map(log_p, (gradients, curvatures))


def segment_log_likelihoods(derivatives: FeatureDerivatives, found: Fit) -> Vector:
    """Return `log_likelihoods` of the scaled controls in every segment under a fit, in
    double precision.
    """
    with double_precision():
        theta = np.array([found.weights[name] for name in found.model.names])
        return np.asarray(
            log_likelihoods(
                derivatives, theta, found.temperature, found.model.floor, found.tails
            )
        )


def fit_weights(
    derivatives: FeatureDerivatives,
    model: RewardModel,
    near: Fit | None = None,
    drivers: Numbers | None = None,
) -> Fit:
    """Fit the weights and the temperature that make segments most likely under a weak
    prior, in double precision.

    The logarithms of the weights' sizes and of the temperature have independent normal
    priors with mean 0 and standard deviation 4. Where the segments carry no information
    about a weight, its prior remains, and the covariance shows it.

    Args:
        derivatives: of the features ``model.names``, in their order.
        model: the weights to learn and those given.
        near: a fit to start from.
        drivers: number of each segment's driver, for the covariance; by default, all
            segments are independent.

    Raises:
        DivergenceError: if weights grow, or the temperature grows or falls, without
            bound.
        ValueError: if the fit does not converge.
    """
    learned = len(model.learned)
    remedy = "learn fewer weights, or from more driving"
    names = [
        *(f"the weight of {name}" for name in model.learned),
        "the temperature",
        "the number of the tails",
    ]
    with double_precision():
        given = np.array([*model.given.values()], dtype=float)
        data = jax.device_put(derivatives), model.floor, model.signs(), given

        def loss(logarithms: Parameters) -> tuple[float, np.ndarray]:
            (value, _), slope = _loss(logarithms, *data)
            return float(value), np.asarray(slope)

        first = np.zeros(learned + 1 + model.tails) if near is None else near.logarithms

        def curvature(logarithms: Parameters) -> np.ndarray:
            hessian = slope_differences(
                lambda near: loss(near)[1], logarithms, DIFFERENCE
            )
            up = [
                f"{name} grows"
                for name, value in zip(names, logarithms[: learned + 1], strict=False)
                if value > LARGEST
            ]
            down = ["the temperature falls"] * bool(logarithms[learned] < -LARGEST)
            if up or down or not np.isfinite(hessian).all():
                inside = np.clip(
                    logarithms, -LARGEST, LARGEST
                )  # where likelihoods are finite
                (_, before), (_, after) = (
                    _loss(place, *data)[0] for place in (first, inside)
                )
                steepest = f"{names[np.abs(logarithms).argmax()]} changes"
                raise DivergenceError(
                    " and ".join([*up, *down] or [steepest]),
                    int(np.nan_to_num(after - before).argmax()),
                )
            return hessian

        found = optimize.minimize(
            loss,
            first,
            jac=True,
            hess=curvature,
            method="trust-exact",
            options=TRUST_REGION,
        )
        best = found.x
        weights = model.weights(found.x)
        hessian = curvature(found.x)
        (_, likelihoods), slope = _loss(best, *data)
        if np.abs(slope).max() >= TOLERANCE:
            far = (
                f"{names[np.abs(slope).argmax()]} still changes after {found.nit}"
                " iterations"
            )
            raise ValueError(f"the fit has not converged: {far}; {remedy}")
        covariance = np.linalg.pinv(
            len(derivatives) * (hessian + hessian.T) / 2, hermitian=True
        )
        if drivers is not None:
            covariance = grouped_covariance(
                covariance, np.asarray(_segment_scores(best, *data)), drivers
            )
        log_likelihood = float(likelihoods.mean())
    temperature, *tails = np.exp(best[learned:]).tolist()
    return Fit(
        model,
        best,
        covariance,
        int(found.nit),
        log_likelihood,
        weights,
        temperature,
        *(tails or [None]),
    )


def _segment_likelihoods(
    logarithms: Parameters,
    derivatives: FeatureDerivatives,
    floor: float,
    signs: Parameters,
    given: Parameters,
) -> Vector:
    """Return log p of every segment; the logarithms are those of `Fit`."""
    sizes = jnp.exp(logarithms)
    learned = len(signs)
    temperature, *tails = sizes[learned:]
    return log_likelihoods(
        derivatives,
        jnp.concatenate([signs * sizes[:learned], given]),
        temperature,
        floor,
        *tails,
    )


@jit_quickly
@partial(jax.value_and_grad, has_aux=True)
def _loss(logarithms: Parameters, *data: Any) -> tuple[Scalar, Vector]:
    """Return minus the mean log p under the prior, and log p of each segment."""
    each = _segment_likelihoods(logarithms, *data)
    return (
        jnp.sum(logarithms**2) / (2 * PRIOR_SPREAD**2 * len(each)) - jnp.mean(each),
        each,
    )


_segment_scores = jit_quickly(
    jax.jacfwd(_segment_likelihoods)
)  # slopes of log p of each segment [n, parameters]
