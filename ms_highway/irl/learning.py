"""Learn a reward from recordings: cut windows, fit all of them, cross-validate, count features."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.features import motion_reward
from ms_highway.game.game import Game, bounded, constant_velocity, discomfort, move
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.game.reward import COMFORT
from ms_highway.game.reward_model import RewardModel
from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.irl.maximum_entropy import FeatureDerivatives, Fit, differentiate, fit, log_likelihoods
from ms_highway.irl.moments import cut_moments
from ms_highway.irl.predictors import learn_peers
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.windows import Windows, driver_game, regular_windows, with_window
from ms_highway.optimization.solvers import optimize_controls
from ms_highway.runtime.arrays import unrolled_sum
from ms_highway.runtime.batches import in_batches
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.progress import Progress, silent

__all__ = [
    "COMFORT_GIVEN",
    "REAL",
    "SIMULATED",
    "best_controls",
    "converged",
    "curvatures",
    "expected_features",
    "folds",
    "learn",
    "window_log_likelihoods",
]

COMFORT_GIVEN = 0.1
"""Comfort weight that sets the scale of all others; small against the curvature of the published weights."""

SIMULATED = RewardModel(
    ("speed", "lane_alignment", "collision_risk"),
    {"off_road": COMMON_WEIGHTS["off_road"], **dict.fromkeys(COMFORT, COMFORT_GIVEN)},
)
"""Learned from simulated demonstrations: the weights that every driver in the paper has.

The weight of leaving the road is given: drivers on the road carry no information about it, and those who slide along
its edge none that derivatives contain, see `ms_highway.irl.windows.regular`.
"""

REAL = RewardModel(
    (*SIMULATED.learned, "direction", "headway", "closing_speed", "induced_braking", "comfort_steering"),
    {"comfort_acceleration": COMFORT_GIVEN},
    tails=True,
)
"""Learned from real drivers: also weights of interaction with traffic, and of steering relative to accelerating."""


def folds(groups: Int[np.ndarray, "n"], number: int) -> list[Int[np.ndarray, "held"]]:
    """Split group numbers into folds, so that each group is held out once."""
    names = np.unique(groups)
    return np.array_split(names, min(number, len(names)))


def learn(
    recordings: Sequence[Recording],
    model: RewardModel,
    horizon: int,
    source: str,
    validations: int = 4,
    *,
    progress: Progress = silent,
) -> LearnedReward:
    """Learn a reward from all drivers of the recordings; of measured ones, also what `learn_drivers` learns.

    Args:
        recordings: the recordings to learn from.
        model: the weights to learn and those given.
        horizon: K, the length of the windows in steps.
        source: name of the data, for the provenance.
        validations: number of folds of the cross-validated likelihood.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no window is regular, the weights diverge, or a fit does not converge.
    """
    progress("cutting windows")
    windows = regular_windows(recordings, horizon)
    progress(f"differentiating {len(windows)} windows")
    derivatives = differentiate(windows, model.names)
    progress("fitting")
    real = recordings[0].measured
    found = converged(fit(derivatives, model, drivers=windows.driver if real else None))
    held_out = []
    parts = folds(windows.group, validations)
    for number, names in enumerate(parts if len(parts) > 1 else [], 1):
        chosen = np.isin(windows.group, names)
        progress(f"cross-validating, {number} of {len(parts)}")
        rest = converged(fit(derivatives.of(~chosen), model, found))
        own = rest.weights, rest.temperature, rest.tails
        held_out.append(window_log_likelihoods(derivatives.of(chosen), model, *own))
    drivers = None
    if real:
        moments = cut_moments(recordings)
        drivers = learn_drivers(moments, progress=progress)
        progress("fitting the predictors to compare with")
        drivers = replace(drivers, peers=learn_peers(moments))
    progress("counting features")
    return LearnedReward(
        weights=found.weights,
        temperature=found.temperature,
        learned=model.learned,
        covariance=found.covariance.tolist(),
        horizon=horizon,
        converged=found.converged,
        iterations=found.iterations,
        windows=len(windows),
        log_likelihood={
            "train": found.log_likelihood,
            "held_out": float(np.concatenate(held_out).mean()) if held_out else None,
        },
        feature_counts={
            "human": dict(zip(model.names, derivatives.features.mean(axis=0).tolist(), strict=True)),
            "model": dict(zip(model.names, expected_features(windows, found).tolist(), strict=True)),
        },
        provenance={
            "data": source,
            "groups": len({recording.group for recording in recordings}),
            "drivers": sum(len(recording.drivers) for recording in recordings),
            "versions": {package: version(package) for package in ("ms-highway", "jax", "numpy", "scipy")},
        },
        tails=found.tails,
        drivers=drivers,
    )


def converged(found: Fit) -> Fit:
    """Return the fit.

    Raises:
        ValueError: if it has not converged.
    """
    if not found.converged:
        raise ValueError(
            f"the fit has not converged after {found.iterations} iterations, at {found.weights}; "
            "learn fewer weights, or from more driving"
        )
    return found


def window_log_likelihoods(
    derivatives: FeatureDerivatives,
    model: RewardModel,
    weights: Mapping[str, float],
    temperature: float,
    tails: float | None = None,
) -> Float[np.ndarray, "n"]:
    """Return log p of the scaled controls in every window, see `log_likelihoods`, in double precision."""
    with jax.enable_x64(True):
        theta = jnp.array([weights[name] for name in model.names])
        data = FeatureDerivatives(*map(jnp.asarray, derivatives))
        return np.asarray(log_likelihoods(data, theta, temperature, model.floor, tails))


def best_controls(windows: Windows, sharp_weights: Mapping[str, float]) -> Float[np.ndarray, "n K 2"]:
    """Return the controls of a local optimum of a reward in every window, found from keeping the velocity.

    Args:
        windows: start, road and recorded neighbours of each driver.
        sharp_weights: weights of the reward by name, divided by the temperature.
    """
    game = driver_game(windows, sharp_weights)
    game = replace(game, planner=replace(game.planner, solver="newton"))
    return in_batches(partial(_best_controls, game), windows)


@jit_quickly
def _best_controls(game: Game, windows: Windows) -> Float[jax.Array, "n K 2"]:
    def best(window: Windows) -> Float[jax.Array, "K 2"]:
        here, others = with_window(game, window), observe(window.others)
        scaled = optimize_controls(
            here.planner,
            partial(move, here, window.start),
            lambda path: unrolled_sum(motion_reward(here.scene, here.robot, Motion(*path), others)),
            partial(discomfort, here, window.start),
            constant_velocity(here, window.start),
            partial(bounded, here, window.start),
        )
        return scaled * here.planner.control_scale

    return jax.vmap(best)(windows)


def curvatures(
    windows: Windows, controls: Float[np.ndarray, "n K 2"], found: Fit
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d d"]]:
    """Return eigenvalues of -H / T at given controls, bounded from below as in the fit, and eigenvectors."""
    derivatives = differentiate(replace(windows, controls=controls), found.model.names)
    return _curvatures(derivatives, found)


def _curvatures(
    derivatives: FeatureDerivatives, found: Fit
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n d d"]]:
    theta = np.array([found.weights[name] for name in found.model.names])
    values, vectors = np.linalg.eigh(-np.einsum("f,nfde->nde", theta, derivatives.hessians) / found.temperature)
    return np.maximum(values, found.model.floor / found.temperature), vectors


def expected_features(windows: Windows, found: Fit) -> Float[np.ndarray, "names"]:
    """Return the features' expected sums over a window under the fit's distribution of controls, mean over windows.

    To second order around the best controls u*: ``phi(u*) + tr(H_phi S) / 2`` with ``S = T (-H)^-1``, the eigenvalues
    of -H bounded as in the fit.
    """
    best = replace(windows, controls=best_controls(windows, found.sharp_weights))
    derivatives = differentiate(best, found.model.names)
    values, vectors = _curvatures(derivatives, found)
    spread = np.einsum("nde,ne,nfe->ndf", vectors, 1 / values, vectors)
    return np.mean(derivatives.features + np.einsum("nfde,nde->nf", derivatives.hessians, spread) / 2, axis=0)
