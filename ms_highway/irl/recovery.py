"""Recover known weights from demonstrations, and measure the regret of planning with the recovered ones."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pandas as pd
from jax import numpy as jnp
from jaxtyping import Float
from scipy import optimize

from ms_highway.game.dynamics import keep_velocity, observe
from ms_highway.game.game import Game
from ms_highway.game.reward import COMFORT, FEATURES
from ms_highway.game.reward_model import RewardModel
from ms_highway.game.scenario import PAPER_DYNAMICS, driving_game
from ms_highway.irl.learning import SIMULATED, window_log_likelihoods
from ms_highway.irl.maximum_entropy import FeatureDerivatives, Fit, differentiate, fit
from ms_highway.irl.recordings.demonstrators import DRIVER_WEIGHTS, optimal
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.windows import Windows, driver_game, features_along, regular_windows, with_window
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.progress import Progress, silent

__all__ = ["IDENTIFIABLE", "recover", "true_rewards"]

IDENTIFIABLE = 0.5
"""Standard deviation of a weight's logarithm below which the weight counts as identifiable; that of the prior
is `ms_highway.irl.maximum_entropy.PRIOR_SPREAD`."""

DEVIATIONS = 1.645  # on either side of the mean: 90 % of a normal distribution
TEMPERATURES = (-30.0, 5.0)  # logarithms between which the best temperature is sought


def recover(
    recordings: Sequence[Recording],
    numbers: Sequence[int],
    model: RewardModel = SIMULATED,
    horizon: int = 5,
    held_out: int = 64,
    *,
    progress: Progress = silent,
) -> pd.DataFrame:
    """Learn the weights of simulated drivers from more and more demonstrations, and compare them with the true ones.

    The true weights are `DRIVER_WEIGHTS`. Learned weights are evaluated on the last demonstrations, which are never
    fitted, and only in windows that are `ms_highway.irl.windows.regular`: elsewhere, at the road's edge, the search for
    the best controls often ends before an optimum, and regrets would measure the search rather than the weights.

    Args:
        recordings: the demonstrations.
        numbers: numbers of demonstrations, the first ones, to learn from.
        model: the weights to learn and those given; these must be the true ones.
        horizon: K, the length of the windows in steps.
        held_out: number of demonstrations, the last ones, to evaluate on.
        progress: called with a message when a part begins.

    Returns:
        A row per number and learned weight, with the columns

        ``demonstrations``, ``windows``: numbers learned from; ``weight``: its name; ``true``; ``learned``; ``low`` and
        ``high``: ends of the 90 % interval, by size; ``log_ratio``: log(learned / true); ``spread``: standard
        deviation of the weight's logarithm; ``identifiable``: whether that is below 0.5; and, the same for all weights
        of a number, ``temperature``; ``converged``; ``log_likelihood`` per held-out window, and
        ``log_likelihood_true`` of the true weights at their most likely temperature; ``regret``: the true reward lost
        by controls that are optimal for the learned weights, as a share of what truly optimal controls gain over
        keeping the velocity.

    Raises:
        ValueError: if there are too few demonstrations, or the true weights of the model are not known.
    """
    _check(recordings, numbers, model, held_out)
    numbers = sorted(set(numbers))
    chosen = [*recordings[: numbers[-1]], *recordings[len(recordings) - held_out :]]
    progress(f"cutting {len(chosen)} demonstrations into windows")
    windows = regular_windows([replace(item, group=str(place)) for place, item in enumerate(chosen)], horizon)
    judged = windows.of(windows.group >= numbers[-1])
    fitted = windows.group < numbers[0]
    if not fitted.any() or not len(judged):
        raise ValueError(f"none of the windows of {numbers[0]} or of the held-out demonstrations can be learned from")
    progress(f"differentiating {len(windows)} windows")
    derivatives = differentiate(windows, model.names)
    rest = derivatives.of(windows.group >= numbers[-1])
    progress(f"planning in {len(judged)} held-out windows")
    earned, plans = true_rewards(judged), _planning(judged)
    best = earned(plans(DRIVER_WEIGHTS))
    kept = np.asarray(keep_velocity(PAPER_DYNAMICS, jnp.asarray(judged.start)))[:, None]
    gain = float((best - earned(np.broadcast_to(kept, judged.controls.shape))).mean())
    reference = _best_likelihood(rest, model)
    rows: list[dict[str, object]] = []
    for number in numbers:
        progress(f"learning from {number} demonstrations")
        first = windows.group < number
        found = fit(derivatives.of(first), model)
        lost = float((best - earned(plans(found.weights))).mean())
        common = {
            "temperature": found.temperature,
            "converged": found.converged,
            "log_likelihood": float(window_log_likelihoods(rest, model, found.weights, found.temperature).mean()),
            "log_likelihood_true": reference,
            "regret": lost / gain,
        }
        counts = {"demonstrations": number, "windows": int(first.sum())}
        rows.extend({**counts, **row, **common} for row in _weights(found))
    return pd.DataFrame(rows)


def true_rewards(windows: Windows) -> Callable[[Float[np.ndarray, "n K 2"]], Float[np.ndarray, "n"]]:
    """Return a function from controls in the windows to their true reward, comfort included."""
    game = driver_game(windows, DRIVER_WEIGHTS)
    theta = jnp.array([DRIVER_WEIGHTS.get(name, 0.0) for name in (*FEATURES, *COMFORT)])
    single = jax.tree.map(lambda numbers: jnp.asarray(numbers, dtype=jnp.float32), windows)

    @jit_quickly
    @jax.vmap
    def rewards(window: Windows, controls: Float[jax.Array, "K 2"]) -> Float[jax.Array, ""]:
        return theta @ features_along(game, window, controls / game.planner.control_scale)

    return lambda controls: np.asarray(rewards(single, jnp.asarray(controls, dtype=jnp.float32)), dtype=float)


def _planning(windows: Windows) -> Callable[[Mapping[str, float]], Float[np.ndarray, "n K 2"]]:
    """Return a function from weights to the controls that an `optimal` driver finds in every window."""
    ahead = windows.start[:, :1] * [1.0, 0.0, 0.0, 0.0]  # in coordinates that begin at the driver, as for them
    near = replace(windows, start=windows.start - ahead, others=windows.others - ahead[:, None, None])

    @jit_quickly
    def plan(game: Game, windows: Windows) -> Float[jax.Array, "n K 2"]:
        def best(window: Windows) -> Float[jax.Array, "K 2"]:
            here = with_window(game, window)
            return optimal(here, window.start, observe(window.others)).controls * game.planner.control_scale

        return jax.vmap(best)(windows)

    def plans(weights: Mapping[str, float]) -> Float[np.ndarray, "n K 2"]:
        scene = jax.tree.map(lambda numbers: numbers[0], windows.scenes)
        game = driving_game(scene, float(windows.speed_limit[0]), weights, grip=None)
        game = replace(game, planner=replace(game.planner, horizon=windows.controls.shape[1]))
        return np.asarray(plan(*jax.tree.map(partial(jnp.asarray, dtype=jnp.float32), (game, near))), dtype=float)

    return plans


def _check(recordings: Sequence[Recording], numbers: Sequence[int], model: RewardModel, held_out: int) -> None:
    if held_out < 1 or not numbers or min(numbers) < 1:
        raise ValueError(
            f"cannot learn from {list(numbers)} demonstrations and test on {held_out}; give one at least of both"
        )
    if max(numbers) + held_out > len(recordings):
        raise ValueError(
            f"there are {len(recordings)} demonstrations; to learn from {max(numbers)} and test on {held_out} others "
            f"takes {max(numbers) + held_out}: record more with `ms-highway irl record`, or use fewer"
        )
    unknown = [name for name in model.learned if name not in DRIVER_WEIGHTS]
    untrue = [name for name, value in model.given.items() if DRIVER_WEIGHTS.get(name) != value]
    if unknown or untrue:
        raise ValueError(f"the simulated drivers' weights of {unknown + untrue} are unknown or others")


def _weights(found: Fit) -> Iterator[dict[str, object]]:
    """Yield a row about each learned weight."""
    for name, variance in zip(found.model.learned, np.diag(found.covariance), strict=False):
        true, learned, spread = float(DRIVER_WEIGHTS[name]), found.weights[name], float(np.sqrt(variance))
        yield {
            "weight": name,
            "true": true,
            "learned": learned,
            "low": learned * np.exp(-DEVIATIONS * spread),
            "high": learned * np.exp(DEVIATIONS * spread),
            "log_ratio": float(np.log(learned / true)),
            "spread": spread,
            "identifiable": spread < IDENTIFIABLE,
        }


def _best_likelihood(derivatives: FeatureDerivatives, model: RewardModel) -> float:
    """Return the mean log-likelihood of the true weights at their most likely temperature."""

    def loss(logarithm: float) -> float:
        return -float(window_log_likelihoods(derivatives, model, DRIVER_WEIGHTS, np.exp(logarithm)).mean())

    return -float(optimize.minimize_scalar(loss, method="bounded", bounds=TEMPERATURES).fun)
