"""Learn a reward by maximum entropy: the one that makes recorded driving likely.

The model: a driver draws the d controls u of a segment, in the planner's scaled units,
from

    p(u) = exp(R(u) / T) / integral of exp(R(u') / T) du',    R(u) = theta . phi(u)

where phi sums the features along the segment, comfort among them, while the other cars
move as recorded. Let g and H be the gradient and the Hessian of R / T at the recorded
controls. Laplace's approximation of the integral around these controls gives (Levine
and Koltun 2012, Eq. 4)

    log p(u) = g^T H^-1 g / 2 + log det(-H) / 2 - (d / 2) log 2 pi

The first term is large if the driver was near an optimum, the second if that optimum is
sharp. g and H are linear in theta: the features' derivatives are computed once, and a
fit then takes seconds.

Real drivers are mostly near an optimum, and now and then far from it. Their temperature
therefore varies from segment to segment: it is T times an inverse-gamma variable with
both parameters ``nu / 2``. This makes p a multivariate Student t distribution with nu
degrees of freedom, called its *tails*::

    log p(u) = -(nu + d) / 2 log(1 - g^T H^-1 g / nu) + log det(-H) / 2
               + log Gamma((nu + d) / 2) - log Gamma(nu / 2) - (d / 2) log(nu pi)
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

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
from ms_highway.runtime.arrays import Array, Scalar, Vector
from ms_highway.runtime.compilation import in_batches, jit_quickly
from ms_highway.runtime.jax_settings import double_precision


@dataclass(frozen=True)
class WeightFit:
    """Set how weights are fitted."""

    prior_deviation: float = 4.0
    """Standard deviation of log |theta| and log T around 0: weak, as two of them are a
    factor of 3000.
    """
    difference: float = 1e-4
    """Difference of log theta, for the Hessian of the log-likelihood."""
    tolerance: float = 1e-3
    """Largest slope of the loss, in any logarithm, of a fit that has converged."""
    initial_trust_radius: float = 1.0
    """Of logarithms: a factor of e."""
    max_trust_radius: float = 3.0
    """Of logarithms: a factor of 20."""
    iterations: int = 200
    """Of the optimiser, at most."""

    @property
    def largest_logarithm(self) -> float:
        """Size of a logarithm beyond which a weight or the temperature diverges.

        Five standard deviations are a factor of 5e8.
        """
        return 5 * self.prior_deviation


WEIGHT_FIT = WeightFit()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FeatureDerivatives(Rows):
    """The features of n segments and their derivatives in d scaled controls.

    They are at the recorded controls.

    Attributes:
        features: phi, summed along each segment.
        gradients: first derivatives.
        hessians: second derivatives.
    """

    features: Float[Array, "n names"]
    gradients: Float[Array, "n names d"]
    hessians: Float[Array, "n names d d"]


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
    covariance: Float[Array, "parameters parameters"]
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
    computed = (*game.robot.names, *COMFORT)
    columns = np.array([computed.index(name) for name in names])
    of_all = in_batches(partial(_differentiate, game), segments)
    derivatives = jax.tree.map(lambda part: part[:, columns].astype(float), of_all)

    # A sum is finite only if all its terms are.
    sums = np.zeros(len(segments))
    for part in jax.tree.leaves(derivatives):
        sums = sums + part.sum(axis=tuple(range(1, part.ndim)))
    if not np.isfinite(sums).all():
        segment = np.isfinite(sums).argmin()
        raise ValueError(
            f"the features of segment {segment} have no finite derivatives; it starts"
            f" at {segments.start[segment]}"
        )
    return derivatives


@jit_quickly
@partial(jax.vmap, in_axes=(None, 0))
def _differentiate(game: Game, segment: Segments) -> FeatureDerivatives:
    """Return the derivatives of all features and of `COMFORT`.

    One compilation serves any choice of them.
    """

    def features(controls: jax.Array) -> jax.Array:
        return summed_features(game, segment, controls.reshape(-1, 2))

    controls = jnp.asarray(segment.controls / game.planner.control_scale).ravel()
    gradients = jax.jacrev(features)
    hessians = jax.jacfwd(gradients)
    return FeatureDerivatives(
        features(controls), gradients(controls), hessians(controls)
    )


@jax.jit
def log_likelihoods(
    derivatives: FeatureDerivatives,
    theta: Vector,
    temperature: float | Scalar,
    floor: float,
    tails: float | Scalar | None = None,
) -> Vector:
    """Return Laplace's log p of the scaled controls in every segment.

    Eigenvalues of -H are at least ``floor / T``.

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

        # -H = root root^T, with a floor below its eigenvalues. If -H less the floor has
        # a Cholesky factor, nothing is below the floor.
        above_floor = jnp.linalg.cholesky(curvature - lowest * jnp.eye(d))
        is_above_floor = jnp.isfinite(above_floor).all()
        positive = jax.lax.cond(
            is_above_floor,
            lambda same: same,
            lambda low: floored(low, lowest),
            curvature,
        )
        root = jnp.linalg.cholesky(positive)

        # -g^T H^-1 g, and log det(-H) / 2.
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
    """Return `log_likelihoods` of every segment under a fit, in double precision."""
    model = found.model
    with double_precision():
        theta = np.array([found.weights[name] for name in model.names])
        likelihoods = log_likelihoods(
            derivatives, theta, found.temperature, model.floor, found.tails
        )
        return np.asarray(likelihoods)


def fit_weights(
    derivatives: FeatureDerivatives,
    model: RewardModel,
    near: Fit | None = None,
    drivers: Numbers | None = None,
) -> Fit:
    """Fit the weights and the temperature that make segments most likely.

    There is a weak prior; numbers are in double precision. The logarithms of the
    weights' sizes and of the temperature have independent normal priors with mean 0 and
    standard deviation 4. Where the segments carry no information about a weight, its
    prior remains, and the covariance shows it.

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
    first = np.zeros(learned + 1 + model.tails) if near is None else near.logarithms
    with double_precision():
        given = np.array([*model.given.values()], dtype=float)
        data = FitData(jax.device_put(derivatives), model.floor, model.signs(), given)
        best, iterations = _minimum(first, data, model)
        hessian = _checked_curvature(best, first, data, model)
        (_, likelihoods), slope = _loss(best, *data)
        if np.abs(slope).max() >= WEIGHT_FIT.tolerance:
            name = _parameter_names(model)[np.abs(slope).argmax()]
            raise ValueError(
                f"the fit has not converged: {name} still changes after {iterations}"
                " iterations; learn fewer weights, or from more driving"
            )

        # The loss is a mean over segments, the covariance is of their sum.
        whole_hessian = len(derivatives) * (hessian + hessian.T) / 2
        covariance = np.linalg.pinv(whole_hessian, hermitian=True)
        if drivers is not None:
            scores = np.asarray(_segment_scores(best, *data))
            covariance = grouped_covariance(covariance, scores, np.asarray(drivers))
        log_likelihood = float(likelihoods.mean())
        weights = model.weights(best)
    temperature, *tails = np.exp(best[learned:]).tolist()
    return Fit(
        model=model,
        logarithms=best,
        covariance=covariance,
        iterations=iterations,
        log_likelihood=log_likelihood,
        weights=weights,
        temperature=temperature,
        tails=tails[0] if tails else None,
    )


class FitData(NamedTuple):
    """What the loss of a fit depends on, beside the logarithms.

    Attributes:
        derivatives: of the features in every segment.
        floor: least curvature of -R.
        signs: of the learned weights.
        given: weights that are not learned.
    """

    derivatives: FeatureDerivatives
    floor: float
    signs: Parameters
    given: Parameters


def _minimum(
    first: Parameters,
    data: FitData,
    model: RewardModel,
) -> tuple[Parameters, int]:
    """Return the logarithms at which the loss is least, and the number of iterations.

    Raises:
        DivergenceError: if a logarithm grows or falls without bound.
    """

    def loss(logarithms: Parameters) -> tuple[float, np.ndarray]:
        (value, _), slope = _loss(logarithms, *data)
        return float(value), np.asarray(slope)

    def curvature(logarithms: Parameters) -> np.ndarray:
        return _checked_curvature(logarithms, first, data, model)

    result = optimize.minimize(
        loss,
        first,
        jac=True,
        hess=curvature,
        method="trust-exact",
        options={
            "gtol": WEIGHT_FIT.tolerance / 10,
            "initial_trust_radius": WEIGHT_FIT.initial_trust_radius,
            "max_trust_radius": WEIGHT_FIT.max_trust_radius,
            "maxiter": WEIGHT_FIT.iterations,
        },
    )
    return result.x, int(result.nit)


def _parameter_names(model: RewardModel) -> list[str]:
    """Return what each logarithm of a fit is of, for messages."""
    weights = [f"the weight of {name}" for name in model.learned]
    return [*weights, "the temperature", "the number of the tails"]


def _checked_curvature(
    logarithms: Parameters,
    first: Parameters,
    data: FitData,
    model: RewardModel,
) -> np.ndarray:
    """Return the Hessian of the loss.

    Args:
        logarithms: where the optimiser is.
        first: where it began.
        data: of the fit.
        model: the weights to learn and those given.

    Raises:
        DivergenceError: if a logarithm is too large, or the Hessian is not finite.
    """

    def slope(logarithms: Parameters) -> np.ndarray:
        return np.asarray(_loss(logarithms, *data)[1])

    hessian = slope_differences(slope, logarithms, WEIGHT_FIT.difference)

    largest = WEIGHT_FIT.largest_logarithm
    learned = len(model.learned)
    names = _parameter_names(model)
    diverging = [
        f"{name} grows"
        for name, value in zip(names, logarithms[: learned + 1], strict=False)
        if value > largest
    ]
    if logarithms[learned] < -largest:
        diverging.append("the temperature falls")
    if not diverging and np.isfinite(hessian).all():
        return hessian

    # The segment whose likelihood has grown most, where likelihoods are finite.
    bounded = np.clip(logarithms, -largest, largest)
    (_, before), _ = _loss(first, *data)
    (_, after), _ = _loss(bounded, *data)
    likeliest = int(np.nan_to_num(after - before).argmax())
    steepest = f"{names[np.abs(logarithms).argmax()]} changes"
    raise DivergenceError(" and ".join(diverging or [steepest]), likeliest)


def _segment_likelihoods(
    logarithms: Parameters,
    derivatives: FeatureDerivatives,
    floor: float,
    signs: Parameters,
    given: Parameters,
) -> Vector:
    """Return log p of every segment, given logarithms and the fields of `FitData`.

    The logarithms are those of `Fit`.
    """
    sizes = jnp.exp(logarithms)
    learned = len(signs)
    temperature, *tails = sizes[learned:]
    theta = jnp.concatenate([signs * sizes[:learned], given])
    return log_likelihoods(derivatives, theta, temperature, floor, *tails)


@jit_quickly
@partial(jax.value_and_grad, has_aux=True)
def _loss(
    logarithms: Parameters,
    derivatives: FeatureDerivatives,
    floor: float,
    signs: Parameters,
    given: Parameters,
) -> tuple[Scalar, Vector]:
    """Return minus the mean log p under the prior, and log p of each segment."""
    likelihoods = _segment_likelihoods(logarithms, derivatives, floor, signs, given)
    prior = jnp.sum(logarithms**2) / (
        2 * WEIGHT_FIT.prior_deviation**2 * len(likelihoods)
    )
    return prior - jnp.mean(likelihoods), likelihoods


# Slopes of log p of each segment [n, parameters].
_segment_scores = jit_quickly(jax.jacfwd(_segment_likelihoods))
