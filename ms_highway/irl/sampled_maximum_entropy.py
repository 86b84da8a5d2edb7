"""Maximum entropy over sampled controls: a check of Laplace's approximation without derivatives of the features.

Ziebart et al. (2008) normalise over all trajectories; over continuous ones, the integral is estimated by importance
sampling, with M candidates u_j drawn from a density q around the best controls (Finn et al. 2016)::

    log p(u) = R(u) / T - log (1 / M) sum_j exp(R(u_j) / T) / q(u_j)
"""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game
from ms_highway.game.reward import COMFORT
from ms_highway.irl.learning import best_controls, curvatures
from ms_highway.irl.maximum_entropy import Fit, most_likely
from ms_highway.irl.windows import Windows, driver_game, features_along
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.batches import in_batches
from ms_highway.runtime.compilation import jit_quickly

__all__ = ["Candidates", "draw_candidates", "fit_sampled", "sampled_log_likelihoods"]

WIDER = 1.3  # than Laplace's approximation, so that the candidates cover the distribution's tails


class Candidates(NamedTuple):
    """Features of the controls of n drivers, and of M candidates for each.

    Attributes:
        done: features along the recorded controls.
        possible: features along the candidates.
        log_density: log q of the candidates.
    """

    done: Float[Array, "n names"]
    possible: Float[Array, "n M names"]
    log_density: Float[Array, "n M"]


def draw_candidates(windows: Windows, found: Fit, number: int, seed: int = 0) -> Candidates:
    """Draw candidates from normal distributions around the best controls under a fit, 1.3 times as wide as Laplace's.

    Args:
        windows: start, road and recorded neighbours of each driver.
        found: the fit.
        number: M, of candidates in each window.
        seed: of the random numbers.
    """
    names = found.model.names
    game = driver_game(windows, {}, names)
    columns = np.array([(*game.robot.names, *COMFORT).index(name) for name in names])
    scale = np.asarray(game.planner.control_scale, dtype=float)
    best = best_controls(windows, found.sharp_weights)
    values, vectors = curvatures(windows, best, found)
    normal = np.random.default_rng(seed).normal(size=(len(windows), number, values.shape[-1]))
    deviations = WIDER / np.sqrt(values)
    offsets = np.einsum("nde,ne,nme->nmd", vectors, deviations, normal)
    candidates = (best / scale).reshape(len(windows), 1, -1) + offsets
    log_density = -np.sum(normal**2 / 2 + np.log(2 * np.pi) / 2, axis=-1) - np.log(deviations).sum(axis=-1)[:, None]

    everything = np.concatenate([(windows.controls / scale).reshape(len(windows), 1, -1), candidates], axis=1)
    phi = in_batches(partial(_features, game), (windows, everything))[..., columns].astype(float)
    return Candidates(phi[:, 0], phi[:, 1:], log_density)


@jit_quickly
def _features(game: Game, items: tuple[Windows, Float[jax.Array, "n M d"]]) -> Float[jax.Array, "n M features"]:
    def along(window: Windows, controls: Float[jax.Array, "M d"]) -> Float[jax.Array, "M features"]:
        return jax.vmap(lambda u: features_along(game, window, u.reshape(-1, 2)))(controls)

    return jax.vmap(along)(*items)


def sampled_log_likelihoods(
    candidates: Candidates, theta: Float[jax.Array, "names"], temperature: Float[jax.Array, ""]
) -> Float[jax.Array, "n"]:
    """Return log p of every driver's controls, with the integral estimated from the candidates."""
    earned, possible = (jnp.asarray(phi) @ theta / temperature for phi in (candidates.done, candidates.possible))
    number = candidates.log_density.shape[-1]
    return earned - jax.scipy.special.logsumexp(possible - candidates.log_density, axis=-1) + jnp.log(number)


def fit_sampled(windows: Windows, found: Fit, number: int = 256, seed: int = 0) -> Fit:
    """Fit weights and temperature with sampled normalisation; candidates are drawn around a fit.

    Raises:
        ValueError: if the weights diverge.
    """
    candidates = draw_candidates(windows, found, number, seed)
    return most_likely(sampled_log_likelihoods, candidates, found.model, found.logarithms)
