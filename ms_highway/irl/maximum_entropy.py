"""Maximum-entropy inverse reinforcement learning: the reward that makes recorded driving likely.

A driver is modelled as drawing the controls u of a window, in the planner's scaled units, from

    p(u) = exp(R(u) / T) / integral of exp(R(u') / T) du',    R(u) = theta . phi(u)

with the features along the window, comfort among them, and the other cars moving as recorded. Laplace's
approximation of the integral around what the driver did gives, with the gradient g and the Hessian H of R / T there
(Levine and Koltun 2012, Eq. 4),

    log p(u) = g^T H^-1 g / 2 + log det(-H) / 2 - (d / 2) log 2 pi

The first term is large if the driver was near an optimum, the second if that optimum is sharp. g and H are linear in
theta: the features' derivatives are computed once, and a fit then takes seconds.

Real drivers are mostly near an optimum, and now and then far from it. Their temperature varies from window to window, T
times an inverse-gamma variable of ``nu / 2`` and ``nu / 2``, which makes p a multivariate Student t distribution with
nu degrees of freedom, its *tails*::

    log p(u) = -(nu + d) / 2 log(1 - g^T H^-1 g / nu) + log det(-H) / 2
               + log Gamma((nu + d) / 2) - log Gamma(nu / 2) - (d / 2) log(nu pi)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jax.scipy.linalg import cho_solve
from jax.scipy.special import gammaln
from jaxtyping import Float, Int
from scipy import optimize

from ms_highway.game.game import Game, move
from ms_highway.game.reward import COMFORT
from ms_highway.game.reward_model import RewardModel
from ms_highway.irl.windows import Windows, control_deviation, driver_game, features_along, path_features
from ms_highway.optimization.floored import floored
from ms_highway.optimization.second_derivatives import Trajectory, second_order_expansion
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.batches import in_batches
from ms_highway.runtime.compilation import jit_quickly

__all__ = ["FeatureDerivatives", "Fit", "differentiate", "fit", "log_likelihoods", "most_likely"]

PRIOR_SPREAD = 4.0  # standard deviation of log |theta| and log T around 0: weak, two of it are a factor of 3000
MANY = 600  # windows, of which half as many are fitted first
DIFFERENCE = 1e-4  # of log theta, for the Hessian of the log-likelihood
TOLERANCE = 1e-3  # of the slope of the objective per window, in a fit that has converged
TRUST_REGION = {"gtol": TOLERANCE / 10, "initial_trust_radius": 1.0, "max_trust_radius": 3.0, "maxiter": 200}


class FeatureDerivatives(NamedTuple):
    """The features' derivatives in the d scaled controls of n windows, at the recorded controls.

    Attributes:
        features: phi, summed along each window.
        gradients: first derivatives.
        hessians: second derivatives.
    """

    features: Float[Array, "n names"]
    gradients: Float[Array, "n names d"]
    hessians: Float[Array, "n names d d"]

    def of(self, chosen: np.ndarray) -> "FeatureDerivatives":
        """Return the derivatives in the chosen windows."""
        return FeatureDerivatives(*(part[chosen] for part in self))


@dataclass(frozen=True)
class Fit:
    """Weights and temperature that were fitted.

    Attributes:
        model: the weights that were learned and those given.
        logarithms: of the learned weights' sizes, of the temperature T and, in a model with tails, of nu.
        covariance: of the logarithms: the inverse B of minus the Hessian of the log-likelihood and prior; if drivers
            are told apart, ``B sum_i s_i s_i^T B`` with the score s_i of all windows of driver i (Huber 1967), as the
            windows of one driver are not independent.
        converged: whether the optimiser reached the maximum.
        iterations: of the optimiser.
        log_likelihood: mean over the windows.
    """

    model: RewardModel
    logarithms: Float[np.ndarray, "parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    converged: bool
    iterations: int
    log_likelihood: float

    @property
    def weights(self) -> dict[str, float]:
        """All weights by name."""
        return self.model.weights(self.logarithms)

    @property
    def temperature(self) -> float:
        """T, the spread of the drivers around the optimum, in units of the reward."""
        return float(np.exp(self.logarithms[len(self.model.learned)]))

    @property
    def tails(self) -> float | None:
        """Degrees of freedom nu, None for a normal distribution."""
        return float(np.exp(self.logarithms[-1])) if self.model.tails else None

    @property
    def sharp_weights(self) -> dict[str, float]:
        """The weights over the temperature: the reward in units of log-probability."""
        return {name: weight / self.temperature for name, weight in self.weights.items()}


def differentiate(windows: Windows, names: tuple[str, ...]) -> FeatureDerivatives:
    """Return the derivatives of these features in every window, each by `second_order_expansion`.

    Raises:
        ValueError: if a derivative is not finite.
    """
    game = driver_game(windows, {}, names)
    columns = np.array([(*game.robot.names, *COMFORT).index(name) for name in names])

    def named(batch: Windows) -> FeatureDerivatives:
        return FeatureDerivatives(*(np.asarray(part)[:, columns] for part in _differentiate(game, batch)))

    derivatives = FeatureDerivatives(*(part.astype(np.float64) for part in in_batches(named, windows)))
    for part in derivatives:
        if not np.isfinite(part).all():
            window = int(np.argwhere(~np.isfinite(part))[0][0])
            start = windows.start[window]
            raise ValueError(f"the features of window {window} have no finite derivatives; it starts at {start}")
    return derivatives


@jit_quickly
@partial(jax.vmap, in_axes=(None, 0))
def _differentiate(game: Game, window: Windows) -> FeatureDerivatives:
    """Return the derivatives of all features and of `COMFORT`, so that one compilation serves any choice of them."""
    controls = window.controls / game.planner.control_scale

    def of_one(weights: Float[jax.Array, "names"]) -> tuple[Float[jax.Array, "d"], Float[jax.Array, "d d"]]:
        def reward(path: Trajectory) -> Float[jax.Array, ""]:
            return weights[:-2] @ path_features(game, window, path).sum(axis=0)

        def cost(controls: Float[jax.Array, "K 2"]) -> Float[jax.Array, ""]:
            return weights[-2:] @ jnp.sum(control_deviation(game, window, controls) ** 2, axis=0) / 2

        expansion = second_order_expansion(partial(move, game, window.start), reward, controls, cost)
        return expansion.gradient, expansion.hessian

    features = features_along(game, window, controls)
    return FeatureDerivatives(features, *jax.vmap(of_one)(jnp.eye(len(features))))


@jax.jit
def log_likelihoods(
    derivatives: FeatureDerivatives,
    theta: Float[Array, "names"],
    temperature: float | Float[Array, ""],
    floor: float,
    tails: float | Float[Array, ""] | None = None,
) -> Float[jax.Array, "n"]:
    """Return Laplace's log p of the scaled controls in every window; eigenvalues of -H are at least ``floor / T``.

    Args:
        derivatives: of the features in every window.
        theta: weights of these features.
        temperature: T.
        floor: least curvature of -R.
        tails: nu, None for a normal distribution.
    """

    def window(pair: tuple[jax.Array, jax.Array]) -> jax.Array:
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
    return jax.lax.map(window, (slope, bend))


def fit(
    derivatives: FeatureDerivatives,
    model: RewardModel,
    near: Fit | None = None,
    drivers: Int[np.ndarray, "n"] | None = None,
) -> Fit:
    """Fit the most likely weights and temperature, see `most_likely`.

    Args:
        derivatives: of the features `RewardModel.names`, in their order.
        model: the weights to learn and those given.
        near: a fit to start from; by default, with more than 600 windows, a fit of about 300 of them.
        drivers: number of each window's driver, for the covariance; by default, all windows are independent.

    Raises:
        ValueError: if the weights diverge.
    """
    windows = len(derivatives.features)
    if near is None and windows > MANY:
        near = fit(derivatives.of(np.arange(0, windows, windows * 2 // MANY)), model)
    begin = None if near is None else near.logarithms
    return most_likely(_above_floor, (derivatives, model.floor), model, begin, drivers)


def _above_floor(
    data: tuple[FeatureDerivatives, jax.Array], theta: Float[jax.Array, "names"], *spread: Float[jax.Array, ""]
) -> Float[jax.Array, "n"]:
    """`log_likelihoods` of derivatives and a floor, with a temperature and perhaps tails."""
    derivatives, floor = data
    return log_likelihoods(derivatives, theta, spread[0], floor, *spread[1:])


Likelihoods: TypeAlias = Callable[..., Float[jax.Array, "n"]]
"""Log p of each of n data, of (data, theta, temperature) and, in a model with tails, of nu."""


def most_likely(
    likelihoods: Likelihoods,
    data: Any,
    model: RewardModel,
    begin: Float[np.ndarray, "parameters"] | None = None,
    drivers: Int[np.ndarray, "n"] | None = None,
) -> Fit:
    """Fit the weights and the temperature that make data most likely under a weak prior, in double precision.

    The logarithms of the weights' sizes and of the temperature have independent normal priors with mean 0 and standard
    deviation 4. Where the data carry no information about a weight, its prior remains, and the covariance shows it.

    Args:
        likelihoods: log p of each of n data, of (data, theta in the order of `RewardModel.names`, temperature); a
            module-level function, so that it is compiled once for data of the same shapes.
        data: a pytree of arrays.
        model: the weights to learn and those given.
        begin: the logarithms to start from.
        drivers: see `fit`.

    Raises:
        ValueError: if the weights diverge.
    """
    with jax.enable_x64(True):
        given = jnp.array([float(value) for value in model.given.values()])
        signs, data = jnp.asarray(model.signs()), jax.tree.map(jnp.asarray, data)

        def loss(logarithms: np.ndarray) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
            return _loss(likelihoods, jnp.asarray(logarithms), data, signs, given)

        def value(logarithms: np.ndarray) -> float:
            return float(loss(logarithms)[0][0])

        def slope(logarithms: np.ndarray) -> np.ndarray:
            return np.asarray(loss(logarithms)[1])

        def bend(logarithms: np.ndarray) -> np.ndarray:
            steps = DIFFERENCE * np.eye(len(logarithms))
            rows = [slope(logarithms + step) - slope(logarithms - step) for step in steps]
            if not np.isfinite(rows).all():
                weights = model.weights(logarithms)
                raise ValueError(f"the weights diverge, at {weights}; learn fewer of them, or from more driving")
            return np.stack(rows) / (2 * DIFFERENCE)

        first = np.zeros(len(model.learned) + 1 + model.tails) if begin is None else begin

        found = optimize.minimize(value, first, jac=slope, hess=bend, method="trust-exact", options=TRUST_REGION)
        top = np.asarray(found.x)
        hessian, converged = bend(top), bool(np.abs(slope(top)).max() < TOLERANCE)
        each = np.asarray(loss(top)[0][1])
        covariance = np.linalg.pinv(len(each) * (hessian + hessian.T) / 2, hermitian=True)
        if drivers is not None:
            scores = np.asarray(_scores(likelihoods, jnp.asarray(top), data, signs, given))
            of_drivers = np.stack([scores[drivers == driver].sum(axis=0) for driver in np.unique(drivers)])
            covariance = covariance @ (of_drivers.T @ of_drivers) @ covariance
    return Fit(model, top, covariance, converged, int(found.nit), float(each.mean()))


@partial(jit_quickly, static_argnums=(0,))
@partial(jax.value_and_grad, argnums=1, has_aux=True)
def _loss(
    likelihoods: Likelihoods,
    logarithms: Float[jax.Array, "parameters"],
    data: Any,
    signs: Float[jax.Array, "learned"],
    given: Float[jax.Array, "given"],
) -> tuple[Float[jax.Array, ""], Float[jax.Array, "n"]]:
    """Return minus the mean log p under the prior, and log p of each of the data."""
    each = _each(likelihoods, logarithms, data, signs, given)
    return jnp.sum(logarithms**2) / (2 * PRIOR_SPREAD**2 * len(each)) - jnp.mean(each), each


@partial(jit_quickly, static_argnums=(0,))
def _scores(likelihoods: Likelihoods, logarithms: jax.Array, *rest: Any) -> Float[jax.Array, "n parameters"]:
    """Return the slopes of log p of each of the data in the logarithms, for the arguments of `_loss`."""
    return jax.jacfwd(lambda logarithms: _each(likelihoods, logarithms, *rest))(logarithms)


def _each(
    likelihoods: Likelihoods,
    logarithms: Float[jax.Array, "parameters"],
    data: Any,
    signs: Float[jax.Array, "learned"],
    given: Float[jax.Array, "given"],
) -> Float[jax.Array, "n"]:
    sizes = jnp.exp(logarithms)
    return likelihoods(data, jnp.concatenate([signs * sizes[: len(signs)], given]), *sizes[len(signs) :])
