"""Evaluate a learned reward on recorded drivers, beside constant velocity and highway-env's IDM.

An evaluation is a dictionary of plain numbers: for ``model``, ``constant_velocity`` and ``idm`` the `errors` of
prediction by horizon and the mean ``log_likelihood`` of a window's scaled controls; the number of predicted
``windows``, of their ``tracks``, and of ``likelihood_windows``; errors by driving regime (``situations``, see
`ms_highway.irl.regimes`); and ``others``, see `ms_highway.irl.prediction.Others`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.game.reward_model import RewardModel
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl.learning import converged, folds, window_log_likelihoods
from ms_highway.irl.maximum_entropy import differentiate, fit
from ms_highway.irl.prediction import (
    STEPS,
    Cases,
    Others,
    constant_velocity,
    cut_cases,
    drive,
    errors,
    gaussian_log_likelihoods,
    idm,
    idm_controls,
)
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.regimes import errors_by_regime
from ms_highway.irl.windows import Windows, regular_windows
from ms_highway.runtime.files import read_json
from ms_highway.runtime.progress import Progress, silent

__all__ = ["cross_validate", "evaluate", "load_evaluation"]

PREDICTORS = ("model", "constant_velocity", "idm")


def evaluate(
    recordings: Sequence[Recording],
    learned: LearnedReward,
    others: Others = "recorded",
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Evaluate a learned reward on recordings; ``progress`` is called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for long enough.
    """
    progress("cutting windows")
    cases, windows = cut_cases(recordings, others), regular_windows(recordings, learned.horizon)
    progress(f"driving {len(cases)} stretches of road")
    paths = drive(cases, learned.sharp_weights, learned.horizon)
    progress(f"differentiating {len(windows)} windows")
    derivatives = differentiate(windows, learned.model.names)
    likely = window_log_likelihoods(derivatives, learned.model, learned.weights, learned.temperature)
    progress("driving IDM vehicles")
    return _beside(cases, paths, windows, likely, others)


def cross_validate(
    recordings: Sequence[Recording],
    model: RewardModel,
    horizon: int,
    parts: int,
    others: Others = "recorded",
    *,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Evaluate rewards by cross-validation: each fold is predicted by a reward learned from the other folds.

    Args:
        recordings: all recordings, split into folds by group.
        model: the weights to learn and those given.
        horizon: K, the length of windows and plans in steps.
        parts: the number of folds.
        others: motion of the other cars in predictions, see `ms_highway.irl.prediction.Others`.
        progress: called with a message when a part begins.

    Returns:
        The evaluation over all folds, with the weights of each (``folds``).

    Raises:
        ValueError: if there is one group only, no driver was seen for long enough, or a fit does not converge.
    """
    progress("cutting windows")
    cases, windows = cut_cases(recordings, others), regular_windows(recordings, horizon)
    if len(np.unique(windows.group)) < 2 or parts < 2:
        raise ValueError(
            "cross-validation needs two folds and recordings of two groups; give more, or evaluate a theta"
        )
    progress(f"differentiating {len(windows)} windows")
    derivatives = differentiate(windows, model.names)
    paths, likely, weights = np.empty((len(cases), STEPS, 2)), np.empty(len(windows)), []
    held_out = folds(np.union1d(windows.group, cases.group), parts)
    found = None
    for number, names in enumerate(held_out, 1):
        held, driven = np.isin(windows.group, names), np.isin(cases.group, names)
        progress(f"learning, fold {number} of {len(held_out)}")
        found = converged(fit(derivatives.of(~held), model, found))
        weights.append({"weights": found.weights, "temperature": found.temperature})
        if held.any():
            likely[held] = window_log_likelihoods(derivatives.of(held), model, found.weights, found.temperature)
        if driven.any():
            progress(f"driving, fold {number} of {len(held_out)}")
            paths[driven] = drive(cases.of(driven), found.sharp_weights, horizon)
    progress("driving IDM vehicles")
    return {**_beside(cases, paths, windows, likely, others), "folds": weights}


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
    missing = [name for name in ("windows", "tracks", "situations", *PREDICTORS) if name not in evaluation]
    for name in PREDICTORS:
        row = evaluation.get(name)
        for kind in ("fde", "miss"):
            values = row.get(kind) if isinstance(row, dict) else None
            usable = isinstance(values, dict) and all(
                horizon.isdecimal() and isinstance(value, (int, float)) for horizon, value in values.items()
            )
            if not usable and name not in missing:
                missing.append(f"{name}.{kind}")
        likely = row.get("log_likelihood") if isinstance(row, dict) else None
        if not isinstance(likely, (int, float)) and name not in missing:
            missing.append(f"{name}.log_likelihood")
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}, or they are no numbers; {remedy}")
    return evaluation


def _beside(
    cases: Cases,
    paths: Float[np.ndarray, "n 50 2"],
    windows: Windows,
    likely: Float[np.ndarray, "windows"],
    others: Others,
) -> dict[str, Any]:
    """Return the evaluation of predicted paths and log-likelihoods, with those of constant velocity and IDM."""
    kept = np.repeat(
        keep_velocity(PAPER_DYNAMICS, np.asarray(windows.start))[:, None], windows.controls.shape[1], axis=1
    )
    rows = {
        "model": (paths, likely),
        "constant_velocity": (constant_velocity(cases), gaussian_log_likelihoods(windows, kept)),
        "idm": (idm(cases), gaussian_log_likelihoods(windows, idm_controls(windows))),
    }
    return {
        **{name: {**errors(path, cases), "log_likelihood": float(log.mean())} for name, (path, log) in rows.items()},
        "situations": errors_by_regime({name: path for name, (path, _) in rows.items()}, cases),
        "windows": len(cases),
        "tracks": len(np.unique(cases.track)),
        "likelihood_windows": len(windows),
        "others": others,
    }
