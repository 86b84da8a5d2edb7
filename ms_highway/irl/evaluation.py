"""Evaluate learned drivers on recordings, beside the predictors of `ms_highway.irl.predictors`.

An evaluation is a dictionary of plain numbers: ``predictors``, by name, with what `ms_highway.irl.errors.measures`
returns; ``situations``, by driving regime (see `ms_highway.irl.regimes`), with mean ``distance`` [m] and ``log_p`` of
each predictor by horizon; ``likelihood``: mean log p of the scaled controls in windows of half a second (see
`ms_highway.irl.maximum_entropy`), under the learned reward and at constant velocity, and of how many ``windows``;
numbers of predicted ``windows`` and of ``tracks``; and ``others``, see `ms_highway.irl.driving.Others`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import optimize, special

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.game.reward_model import RewardModel
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl.driving import Others
from ms_highway.irl.errors import Outcomes, measures, outcomes
from ms_highway.irl.learning import converged, folds, window_log_likelihoods
from ms_highway.irl.maximum_entropy import differentiate, fit
from ms_highway.irl.moments import Moments, cut_moments
from ms_highway.irl.predictors import PREDICTORS, Prediction, check_drivers, learn_peers, predictions
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.regimes import by_regime
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.windows import Windows, driver_game, regular_windows
from ms_highway.runtime.files import read_json
from ms_highway.runtime.progress import Progress, silent

__all__ = ["cross_validate", "evaluate", "kept_log_likelihoods", "load_evaluation"]

LEAST_DEVIATION, MOST = 1e-6, 1e3  # of scaled controls; and of tails


def evaluate(
    recordings: Sequence[Recording],
    learned: LearnedReward,
    others: Others = "predicted",
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Evaluate a learned reward on recordings; ``progress`` is called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for long enough, or the reward has no drivers learned seconds ahead.
    """
    drivers = check_drivers(learned.drivers)
    progress("cutting windows")
    moments, windows = cut_moments(recordings), regular_windows(recordings, learned.horizon)
    progress(f"predicting {moments.predicted.sum()} drivers")
    predicted = predictions(moments, drivers, others)
    progress(f"differentiating {len(windows)} windows")
    derivatives, model = differentiate(windows, learned.model.names), learned.model
    likely = window_log_likelihoods(derivatives, model, learned.weights, learned.temperature, learned.tails)
    progress("measuring")
    parts, fold = {name: [part] for name, part in predicted.items()}, np.zeros(len(moments), dtype=int)
    return _measured(moments, parts, fold, windows, likely, others)


def cross_validate(
    recordings: Sequence[Recording],
    model: RewardModel,
    horizon: int,
    parts: int,
    others: Others = "predicted",
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Evaluate by cross-validation: each fold is predicted by what is learned from the other folds.

    Args:
        recordings: all recordings, split into folds by group, and so by driver.
        model: the weights to learn and those given.
        horizon: K, the length of windows in steps.
        parts: the number of folds.
        others: motion of the other cars in predictions, see `ms_highway.irl.driving.Others`.
        progress: called with a message when a part begins.

    Returns:
        The evaluation over all folds, with the weights of each (``folds``).

    Raises:
        ValueError: if there is one group only, no driver was seen for long enough, or a fit does not converge.
    """
    progress("cutting windows")
    moments, windows = cut_moments(recordings), regular_windows(recordings, horizon)
    if len(np.unique(windows.group)) < 2 or parts < 2:
        raise ValueError(
            "cross-validation needs two folds and recordings of two groups; give more, or evaluate a theta"
        )
    progress(f"differentiating {len(windows)} windows")
    derivatives = differentiate(windows, model.names)
    likely, weights, found = np.empty(len(windows)), [], None
    held_out = folds(np.union1d(windows.group, moments.group), parts)
    predicted: dict[str, list[Prediction]] = {}
    for number, names in enumerate(held_out, 1):
        held, driven = np.isin(windows.group, names), np.isin(moments.group, names)
        progress(f"learning, fold {number} of {len(held_out)}")
        found = converged(fit(derivatives.of(~held), model, found))
        if held.any():
            chosen = derivatives.of(held)
            likely[held] = window_log_likelihoods(chosen, model, found.weights, found.temperature, found.tails)
        drivers = learn_drivers(moments, ~driven, intervals=False)
        drivers = replace(drivers, peers=learn_peers(moments, ~driven))
        weights.append({"weights": found.weights, "temperature": found.temperature, "drivers": dict(drivers.weights)})
        for name, part in predictions(moments, drivers, others).items():
            predicted.setdefault(name, []).append(part)
    fold = np.argmax([np.isin(moments.group, names) for names in held_out], axis=0)
    progress("measuring")
    return {**_measured(moments, predicted, fold, windows, likely, others), "folds": weights}


def load_evaluation(path: Path) -> dict[str, Any]:
    """Read what ``ms-highway irl evaluate --json`` prints.

    Raises:
        ValueError: if the file cannot be read or is no evaluation; the message names what is missing.
    """
    try:
        evaluation = read_json(path)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as an evaluation: {error}") from error
    remedy = "write it again with `ms-highway irl evaluate --json`"
    if not isinstance(evaluation, dict):
        raise ValueError(f"{path} is no evaluation; {remedy}")
    parts = ("windows", "tracks", "others", "situations", "likelihood", "predictors")
    missing = [name for name in parts if name not in evaluation]
    rows, likely, situations = (
        part if isinstance(part := evaluation.get(name), dict) else {}
        for name in ("predictors", "likelihood", "situations")
    )
    numbers = ("model", "constant_velocity", "windows")
    missing += [f"likelihood.{name}" for name in numbers if not isinstance(likely.get(name), (int, float))]
    missing += [f"situations.{name}" for name in ("distance", "log_p") if not isinstance(situations.get(name), dict)]
    missing += [f"predictors.{name}" for name in PREDICTORS if not isinstance(rows.get(name), dict)]
    for name, row in rows.items():
        kinds = ("fde", "rmse", "miss", "log_p", "inside 50", "inside 90", "inside 99")
        for kind in kinds if isinstance(row, dict) else ():
            values = row.get(kind)
            usable = isinstance(values, dict) and all(
                horizon.isdecimal() and isinstance(value, (int, float)) for horizon, value in values.items()
            )
            if not usable:
                missing.append(f"predictors.{name}.{kind}")
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}, or they are no numbers; {remedy}")
    return evaluation


def _measured(
    moments: Moments,
    predicted: Mapping[str, list[Prediction]],
    fold: Int[np.ndarray, "n"],
    windows: Windows,
    likely: Float[np.ndarray, "windows"],
    others: Others,
) -> dict[str, Any]:
    """Return the evaluation of predictions of all moments by what was learned for each fold, and of windows."""
    recorded = moments.recorded
    of_drivers = np.repeat(fold[:, None], moments.predicted.shape[1], axis=1)[moments.predicted]
    found: dict[str, Outcomes] = {}
    for name, parts in predicted.items():
        each = [outcomes(*part, recorded) for part in parts]
        own = of_drivers, np.arange(len(recorded))
        found[name] = Outcomes(*(np.stack(values)[own] for values in zip(*each, strict=True)))
    distances = {name: np.linalg.norm(outcome.path - recorded, axis=-1) for name, outcome in found.items()}
    return {
        "predictors": {name: measures(outcome, recorded) for name, outcome in found.items()},
        "situations": {
            "distance": by_regime(distances, moments),
            "log_p": by_regime({name: outcome.log_p for name, outcome in found.items()}, moments),
        },
        "likelihood": {
            "model": float(likely.mean()),
            "constant_velocity": float(kept_log_likelihoods(windows).mean()),
            "windows": len(windows),
        },
        "windows": int(moments.predicted.sum()),
        "tracks": len(np.unique(moments.track[moments.predicted])),
        "others": others,
    }


def kept_log_likelihoods(windows: Windows) -> Float[np.ndarray, "n"]:
    """Return log p of the scaled controls in every window, if spread around those that keep the velocity.

    Independent but for their common scale: a multivariate Student t distribution, as drivers have whose reward is
    learned. Its two scales and its tails are fitted to the same windows, an advantage over a learned reward.
    """
    scale = np.asarray(driver_game(windows, {}).planner.control_scale, dtype=float)
    kept = keep_velocity(PAPER_DYNAMICS, np.asarray(windows.start))[:, None]
    off = (np.asarray(windows.controls) - kept) / scale
    size = off[0].size

    def each(logarithms: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n"]:
        scales, tails = np.exp(logarithms[:2]), np.exp(logarithms[2])
        squares = np.sum((off / scales) ** 2, axis=(1, 2))
        shape = special.gammaln((tails + size) / 2) - special.gammaln(tails / 2) - size / 2 * np.log(tails * np.pi)
        return shape - size / 2 * np.log(scales).sum() - (tails + size) / 2 * np.log1p(squares / tails)

    first = np.log([*np.maximum(np.sqrt(np.mean(off**2, axis=(0, 1))), LEAST_DEVIATION), 2.0])
    bounds = np.log([(LEAST_DEVIATION, MOST), (LEAST_DEVIATION, MOST), (1 / MOST, MOST)])
    return each(optimize.minimize(lambda logs: -each(logs).mean(), first, method="Nelder-Mead", bounds=bounds).x)
