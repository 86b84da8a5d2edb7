"""Evaluate learned drivers on recordings, beside the predictors of `ms_highway.irl.predictors`."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy import optimize, stats

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.learned_drivers import LearnedDrivers
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.game.neighbours import leaders
from ms_highway.game.reward import RewardModel
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl import Others
from ms_highway.irl.arrays import Flags, Parameters, Paths, Steps, Values
from ms_highway.irl.learning import folds
from ms_highway.irl.maximum_entropy import Fit, differentiate, fit_weights, window_log_likelihoods
from ms_highway.irl.moments import AT, HORIZONS, Moments, cut_moments
from ms_highway.irl.outlook import expected_path, log_density, region_level
from ms_highway.irl.predictors import PREDICTORS, Prediction, check_drivers, prediction
from ms_highway.irl.recordings.recording import Recording
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.windows import Windows, driver_game, regular_windows
from ms_highway.runtime.progress import Progress, silent

MISS = 2.0  # m
LEVELS = (50, 90, 99)
"""Percentages of probability in the predicted regions whose calibration is measured."""

HORIZON = 3  # s, at which regimes are distinguished
LANE_CHANGE = 1.5  # m to the side
HARD = 1.0  # m/s^2, on average
SLOW = 5.0  # m/s
LEADER = 50.0  # m ahead, from centre to centre

LEAST_DEVIATION, MOST = 1e-6, 1e3  # of scaled controls; and of tails

ByHorizon = dict[str, float]
SITUATIONS = ("distance", "log_p")


class Evaluation(msgspec.Struct, frozen=True, omit_defaults=True):
    """How well drivers were predicted: plain numbers, by horizon in seconds.

    Attributes:
        predictors: what `measures` returns, by predictor.
        situations: mean ``distance`` [m] and ``log_p`` of each predictor, by driving regime, see `driving_regimes`; and
            ``windows``, the number of drivers.
        likelihood: mean log p of the scaled controls in windows of half a second (see
            `ms_highway.irl.maximum_entropy`) under the learned reward (``model``) and at ``constant_velocity``, and the
            number of ``windows``.
        windows: number of predictions.
        tracks: number of drivers.
        others: see `ms_highway.irl.Others`.
        folds: weights of each fold of a cross-validation.
    """

    predictors: dict[str, dict[str, ByHorizon]]
    situations: dict[str, dict[str, dict[str, ByHorizon]]]
    likelihood: dict[str, float]
    windows: int
    tracks: int
    others: Others
    folds: Sequence[dict[str, Any]] = ()


class Judged(NamedTuple):
    """What became of every prediction, NaN where the driver was not seen.

    Attributes:
        distance: from the expected to the recorded position [m].
        log_p: log density of the recorded position [1/m^2].
        level: probability of the region of highest density that just reaches it.
    """

    distance: Steps
    log_p: Steps
    level: Steps


def outcomes(prediction: Prediction, recorded: Paths) -> Judged:
    """Compare predicted distributions with recorded positions."""
    positions = recorded.astype(np.float32)
    distance = np.linalg.norm(expected_path(prediction.modes) - recorded, axis=-1)
    return Judged(distance, np.asarray(log_density(*prediction, positions)), region_level(*prediction, positions))


def measures(found: Judged) -> dict[str, ByHorizon]:
    """Return what a predictor is worth, by horizon in seconds, over the drivers that are seen until then.

    Returns:
        ``fde``: mean distance at the horizon [m]; ``ade``: mean distance up to it [m]; ``rmse``: root mean square of
        the distance at it [m]; ``miss``: share of drivers whose distance at it exceeds 2 m; ``log_p``: mean log density
        of the recorded positions [1/m^2]; ``inside 50`` and so on: share of drivers in the region of highest density
        that holds 50 % of the probability.
    """
    rows: dict[str, ByHorizon] = {}
    for horizon in HORIZONS:
        seen = np.isfinite(found.distance[:, 10 * horizon - 1])
        if not seen.any():
            continue
        until, log_p, level = (part[seen, : 10 * horizon] for part in found)
        last = until[:, -1]
        values = {"fde": last, "ade": until, "rmse": last**2, "miss": last > MISS, "log_p": log_p[:, -1]}
        values |= {f"inside {percent}": level[:, -1] < percent / 100 for percent in LEVELS}
        for kind, value in values.items():
            mean = np.sqrt(value.mean()) if kind == "rmse" else value.mean()
            rows.setdefault(kind, {})[str(horizon)] = float(mean)
    return rows


def evaluate(
    recordings: Sequence[Recording],
    reward: LearnedReward | RewardModel,
    others: Others = "predicted",
    *,
    horizon: int = 5,
    parts: int = 4,
    progress: Progress = silent,
) -> Evaluation:
    """Evaluate a learned reward on recordings; or cross-validate: predict each fold by what the other folds teach.

    Args:
        recordings: all recordings; for a cross-validation, they are split by group, and so by driver.
        reward: that was learned; for a cross-validation, the weights to learn and those given.
        others: motion of the other cars in predictions, see `ms_highway.irl.Others`.
        horizon: K, the length of windows in steps; a learned reward has its own.
        parts: the number of folds of a cross-validation.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if a learned reward has no drivers, a cross-validation has one fold only, no driver was seen for
            long enough, or a fit does not converge.
    """
    given: tuple[LearnedReward, LearnedDrivers] | None = None
    if isinstance(reward, LearnedReward):
        given, model, horizon = (reward, check_drivers(reward.drivers)), reward.model, reward.horizon
    else:
        model = reward
    progress("cutting windows")
    moments, windows = cut_moments(recordings), regular_windows(recordings, horizon)
    groups = np.union1d(windows.group, moments.group)
    if not given and min(parts, len(groups)) < 2:
        raise ValueError(
            "cross-validation needs two folds and recordings of two groups; give more, or evaluate a theta"
        )
    held_out = [groups] if given else folds(groups, parts)
    progress(f"differentiating {len(windows)} windows")
    derivatives = differentiate(windows, model.names)
    likely, fold = np.empty(len(windows)), np.zeros(len(moments), dtype=int)
    judged: dict[str, list[Judged]] = {name: [] for name in PREDICTORS}
    weights: list[dict[str, Any]] = []
    fit: Fit | None = None
    known: Fit | LearnedReward
    for number, names in enumerate(held_out):
        held, driven = np.isin(windows.group, names), np.isin(moments.group, names)
        if given:
            known, drivers = given
        else:
            progress(f"learning, fold {number + 1} of {len(held_out)}")
            known = fit = fit_weights(derivatives.of(~held), model, fit)
            drivers = learn_drivers(moments, ~driven, intervals=False)
            weights.append({"weights": fit.weights, "temperature": fit.temperature, "drivers": drivers.weights})
        progress(f"predicting {driven[moments.which].sum()} drivers")
        likely[held], fold[driven] = window_log_likelihoods(derivatives.of(held), known), number
        for name, outcome in judged.items():
            outcome.append(outcomes(prediction(name, moments, drivers, others), moments.recorded))
    found = {name: moments.by_fold(fold, outcome) for name, outcome in judged.items()}
    likelihood = {"model": likely, "constant_velocity": kept_log_likelihoods(windows)}
    return Evaluation(
        predictors={name: measures(outcome) for name, outcome in found.items()},
        situations=by_regime(found, moments),
        likelihood={name: float(values.mean()) for name, values in likelihood.items()} | {"windows": len(windows)},
        windows=len(moments.which),
        tracks=len(np.unique(moments.drivers(moments.track))),
        others=others,
        folds=tuple(weights),
    )


def driving_regimes(moments: Moments) -> dict[str, Flags]:
    """Return which predicted drivers are in each regime, by name; a driver may be in several, or in none.

    A *lane change* is 1.5 m to the side within 3 s; *braking* and *accelerating* are more than 1 m/s^2 on average over
    that time; *slow* is below 5 m/s at the start; *no leader* is none within 50 m in the own lane at the start;
    *following* is a leader and none of the other regimes.
    """
    start, later = moments.drivers(moments.now), moments.tracks(moments.future)[:, 10 * HORIZON - 1]
    others, reach = moments.now[moments.which], moments.lane_width[moments.which] / 2
    near = (others[..., 0] - start[:, :1] < LEADER)[:, None]
    _, led = leaders(start[:, :1], start[:, 1:2], others, near, reach[:, None, None])
    change = (later[:, 3] - start[:, 3]) / HORIZON
    found = {
        "lane change": np.abs(later[:, 1] - start[:, 1]) > LANE_CHANGE,
        "braking": change < -HARD,
        "accelerating": change > HARD,
        "slow": start[:, 3] < SLOW,
        "no leader": ~led[:, 0],
    }
    return {**found, "following": ~np.any(list(found.values()), axis=0)}


def by_regime(found: Mapping[str, Judged], moments: Moments) -> dict[str, dict[str, dict[str, ByHorizon]]]:
    """Return the means of each predictor by what is measured, regime and horizon; see `Evaluation.situations`.

    Args:
        found: by predictor.
        moments: of the drivers; those seen for less than 3 s are left out.
    """
    reached = np.isfinite(moments.recorded[..., 0])[:, AT]
    rows: dict[str, dict[str, dict[str, ByHorizon]]] = {kind: {} for kind in SITUATIONS}
    for regime, chosen in driving_regimes(moments).items():
        some = chosen & reached[:, HORIZONS.index(HORIZON)]
        if not some.any():
            continue
        counts = {str(at): float(reached[some, place].sum()) for place, at in enumerate(HORIZONS)}
        for kind, row in rows.items():
            row[regime] = {"windows": counts}
            for name, outcome in found.items():
                means = np.asarray(getattr(outcome, kind))[some][:, AT]
                row[regime][name] = {
                    at: float(np.nanmean(means[:, place])) for place, at in enumerate(counts) if counts[at]
                }
    return rows


def kept_log_likelihoods(windows: Windows) -> Values:
    """Return log p of the scaled controls in every window, if spread around those that keep the velocity.

    Independent but for their common scale: a multivariate Student t distribution, as drivers have whose reward is
    learned. Its two scales and its tails are fitted to the same windows, an advantage over a learned reward.
    """
    scale = np.asarray(driver_game(windows, {}).planner.control_scale, dtype=float)
    off = (windows.controls - keep_velocity(PAPER_DYNAMICS, windows.start)[:, None]) / scale
    n, steps, _ = off.shape

    def each(logarithms: Parameters) -> Values:
        scaled, tails = (off / np.exp(logarithms[:2])).reshape(n, -1), np.exp(logarithms[2])
        return stats.multivariate_t.logpdf(scaled, df=tails, shape=np.eye(2 * steps)) - steps * logarithms[:2].sum()

    first = np.log([*np.maximum(np.sqrt(np.mean(off**2, axis=(0, 1))), LEAST_DEVIATION), 2.0])
    bounds = np.log([(LEAST_DEVIATION, MOST), (LEAST_DEVIATION, MOST), (1 / MOST, MOST)])
    return each(optimize.minimize(lambda logs: -each(logs).mean(), first, method="Nelder-Mead", bounds=bounds).x)
