"""Evaluate learned drivers on recordings, beside the peers of `ms_highway.irl.prediction`."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from scipy import optimize, stats

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.learned_reward import LearnedReward
from ms_highway.game.neighbours import leaders
from ms_highway.game.reward import RewardModel
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.irl import Others
from ms_highway.irl.learning import folds
from ms_highway.irl.maximum_entropy import Fit, differentiate, fit_weights, segment_log_likelihoods
from ms_highway.irl.mixture import Mixture, Steps, density_level, expected_path, log_density
from ms_highway.irl.prediction import PREDICTORS, check_drivers, predict_with
from ms_highway.irl.recording import Flags, Recording
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.segments import Segments, cut_segments, driver_game
from ms_highway.irl.snapshots import AT, HORIZONS, Paths, Snapshots, cut_snapshots
from ms_highway.numerics.estimation import Parameters
from ms_highway.runtime.arrays import Vector
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


class Evaluation(msgspec.Struct, frozen=True, omit_defaults=True):
    """How well drivers were predicted: plain numbers, by horizon in seconds.

    Attributes:
        predictors: what `metrics` returns, by predictor.
        situations: mean ``distance`` [m] and ``log_p`` of each predictor, by driving regime, see `driving_regimes`; and
            ``windows``, the number of drivers.
        likelihood: mean log p of the scaled controls in segments of half a second (see
            `ms_highway.irl.maximum_entropy`) under the learned reward (``model``) and at ``constant_velocity``, and the
            number of segments, ``windows``.
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


class Errors(NamedTuple):
    """Errors of predictions after each step, NaN where the driver was not seen.

    Attributes:
        distance: from the expected to the recorded position [m].
        log_p: log density of the recorded position [1/m^2].
        level: probability of the region of highest density that just reaches it.
    """

    distance: Steps
    log_p: Steps
    level: Steps


def prediction_errors(mixture: Mixture, recorded: Paths) -> Errors:
    """Compare predicted distributions with recorded positions."""
    positions = recorded.astype(np.float32)
    distance = np.linalg.norm(expected_path(mixture.modes) - recorded, axis=-1)
    return Errors(distance, np.asarray(log_density(mixture, positions)), density_level(mixture, positions))


def metrics(errors: Errors) -> dict[str, ByHorizon]:
    """Return the metrics of a predictor by horizon in seconds, over the drivers that are seen until then.

    Returns:
        ``fde``: mean distance at the horizon [m]; ``ade``: mean distance up to it [m]; ``rmse``: root mean square of
        the distance at it [m]; ``miss``: share of drivers whose distance at it exceeds 2 m; ``log_p``: mean log density
        of the recorded positions [1/m^2]; ``inside 50`` and so on: share of drivers in the region of highest density
        that holds 50 % of the probability.
    """
    rows: dict[str, ByHorizon] = {}
    for horizon, at in zip(HORIZONS, AT, strict=True):
        seen = np.isfinite(errors.distance[:, at])
        if not seen.any():
            continue
        distance, log_p, level = (part[seen, at] for part in errors)
        values = {
            "fde": distance,
            "ade": errors.distance[seen, : at + 1],
            "rmse": distance**2,
            "miss": distance > MISS,
            "log_p": log_p,
            **{f"inside {percent}": level < percent / 100 for percent in LEVELS},
        }
        for name, value in values.items():
            mean = np.sqrt(value.mean()) if name == "rmse" else value.mean()
            rows.setdefault(name, {})[str(horizon)] = float(mean)
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
        horizon: K, the length of segments in steps; a learned reward has its own.
        parts: the number of folds of a cross-validation.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if a learned reward has no drivers, a cross-validation has one fold only, no driver was seen for
            long enough, or a fit does not converge.
    """
    learned: Fit | LearnedReward
    fit: Fit | None = None
    if isinstance(reward, LearnedReward):
        learned, drivers, model = reward, check_drivers(reward.drivers), reward.model
        horizon, parts = reward.horizon, 1
    else:
        model = reward
    progress("cutting segments")
    snapshots, segments = cut_snapshots(recordings), cut_segments(recordings, horizon)
    held_out = folds(np.union1d(segments.group, snapshots.group), parts)
    if isinstance(reward, RewardModel) and len(held_out) < 2:
        raise ValueError(
            "cross-validation needs two folds and recordings of two groups; give more, or evaluate a theta"
        )
    progress(f"differentiating {len(segments)} segments")
    derivatives = differentiate(segments, model.names)
    likelihoods, fold = np.empty(len(segments)), np.zeros(len(snapshots), dtype=int)
    errors: list[list[Errors]] = []
    weights: list[dict[str, Any]] = []
    for number, names in enumerate(held_out):
        tested, predicted = np.isin(segments.group, names), np.isin(snapshots.group, names)
        if len(held_out) > 1:
            progress(f"learning, fold {number + 1} of {len(held_out)}")
            learned = fit = fit_weights(derivatives.of(~tested), model, fit)
            drivers = learn_drivers(snapshots, ~predicted, intervals=False)
            weights.append({"weights": fit.weights, "temperature": fit.temperature, "drivers": drivers.weights})
        progress(f"predicting {predicted[snapshots.which].sum()} drivers")
        likelihoods[tested] = segment_log_likelihoods(derivatives.of(tested), learned)
        fold[predicted] = number
        mixtures = (predict_with(name, snapshots, drivers, others) for name in PREDICTORS)
        errors.append([prediction_errors(mixture, snapshots.recorded) for mixture in mixtures])
    found: dict[str, Errors] = dict(zip(PREDICTORS, snapshots.by_fold(fold, errors), strict=True))
    likelihood = {"model": likelihoods, "constant_velocity": constant_velocity_log_likelihoods(segments)}
    return Evaluation(
        predictors={name: metrics(each) for name, each in found.items()},
        situations=metrics_by_regime(found, snapshots),
        likelihood={name: float(values.mean()) for name, values in likelihood.items()} | {"windows": len(segments)},
        windows=len(snapshots.which),
        tracks=len(np.unique(snapshots.drivers(snapshots.track))),
        others=others,
        folds=tuple(weights),
    )


def driving_regimes(snapshots: Snapshots) -> dict[str, Flags]:
    """Return which predicted drivers are in each regime, by name; a driver may be in several, or in none.

    A *lane change* is 1.5 m to the side within 3 s; *braking* and *accelerating* are more than 1 m/s^2 on average over
    that time; *slow* is below 5 m/s at the start; *no leader* is none within 50 m in the own lane at the start;
    *following* is a leader and none of the other regimes.
    """
    start, later = snapshots.drivers(snapshots.now), snapshots.drivers(snapshots.future[:, 10 * HORIZON - 1])
    others, reach = snapshots.now[snapshots.which], snapshots.lane_width[snapshots.which] / 2
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


def metrics_by_regime(found: Mapping[str, Errors], snapshots: Snapshots) -> dict[str, dict[str, dict[str, ByHorizon]]]:
    """Return the means of each predictor by what is measured, regime and horizon; see `Evaluation.situations`.

    Args:
        found: by predictor.
        snapshots: of the drivers; those seen for less than 3 s are left out.
    """
    reached = np.isfinite(snapshots.recorded[..., 0])[:, AT]
    rows: dict[str, dict[str, dict[str, ByHorizon]]] = {"distance": {}, "log_p": {}}
    for regime, chosen in driving_regimes(snapshots).items():
        some = chosen & reached[:, HORIZONS.index(HORIZON)]
        if not some.any():
            continue
        counts = {str(at): float(number) for at, number in zip(HORIZONS, reached[some].sum(axis=0), strict=True)}
        for kind, row in rows.items():
            row[regime] = {"windows": counts}
            for name, errors in found.items():
                values = zip(counts.items(), getattr(errors, kind)[some][:, AT].T, strict=True)
                row[regime][name] = {at: float(np.nanmean(value)) for (at, number), value in values if number}
    return rows


def constant_velocity_log_likelihoods(segments: Segments) -> Vector:
    """Return log p of the scaled controls in every segment, if spread around those that keep the velocity.

    Independent but for their common scale: a multivariate Student t distribution, as drivers have whose reward is
    learned. Its two scales and its tails are fitted to the same segments, an advantage over a learned reward.
    """
    scale = np.asarray(driver_game(segments, {}).planner.control_scale, dtype=float)
    off = (segments.controls - keep_velocity(PAPER_DYNAMICS, segments.start)[:, None]) / scale
    n, steps, _ = off.shape

    def each(logarithms: Parameters) -> Vector:
        scaled, tails = (off / np.exp(logarithms[:2])).reshape(n, -1), np.exp(logarithms[2])
        return stats.multivariate_t.logpdf(scaled, df=tails, shape=np.eye(2 * steps)) - steps * logarithms[:2].sum()

    first = np.log([*np.maximum(np.sqrt(np.mean(off**2, axis=(0, 1))), LEAST_DEVIATION), 2.0])
    bounds = np.log([(LEAST_DEVIATION, MOST), (LEAST_DEVIATION, MOST), (1 / MOST, MOST)])
    return each(optimize.minimize(lambda logs: -each(logs).mean(), first, method="Nelder-Mead", bounds=bounds).x)
