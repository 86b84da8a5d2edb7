"""Evaluate learned drivers on recordings, beside their peers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np

from ms_highway.data.learned_drivers import LearnedDrivers
from ms_highway.game.scene import leaders
from ms_highway.irl.horizons import HORIZONS
from ms_highway.irl.mixture import (
    Mixture,
    Steps,
    density_level,
    expected_path,
    log_density,
)
from ms_highway.irl.prediction import PREDICTORS, predict_with
from ms_highway.irl.recording import Flags, Recording, folds
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.snapshots import SNAPSHOT, Paths, Snapshots, cut_snapshots
from ms_highway.irl.usable import usable_recordings
from ms_highway.runtime.process import Progress, silent

MISS = 2.0
"""Distance from which a prediction counts as a miss [m]."""

LEVELS = (50, 90, 99)
"""Percentages of probability in the predicted regions whose calibration is measured."""


@dataclass(frozen=True)
class RegimeLimits:
    """Set where driving regimes begin, see `driving_regimes`."""

    seconds: int = 3
    """Time over which regimes are distinguished [s]."""
    lane_change: float = 1.5
    """Movement to the side in a lane change [m]."""
    acceleration: float = 1.0
    """Mean acceleration or deceleration [m/s^2]."""
    slow: float = 5.0
    """Speed at the start [m/s]."""
    leader_distance: float = 50.0
    """Distance to a leader at the start, from centre to centre [m]."""


REGIME_LIMITS = RegimeLimits()

ByHorizon = dict[str, float]
Situations = dict[str, dict[str, dict[str, ByHorizon]]]
Value = TypeVar("Value")


class Evaluation(msgspec.Struct, frozen=True, omit_defaults=True):
    """How well drivers were predicted: plain numbers, by horizon in seconds.

    Attributes:
        predictors: `metrics` of each predictor, by name.
        situations: mean ``distance`` [m] and mean ``log_p``, by driving regime (see
            `driving_regimes`) and predictor; ``windows`` stands beside the predictors
            and is the number of predictions.
        windows: number of predictions.
        tracks: number of drivers.
        folds: weights that were learned in each fold of a cross-validation.
        learned_from: number of recordings that the drivers were learned from, or that
            may share drivers with these.
    """

    predictors: dict[str, dict[str, ByHorizon]]
    situations: Situations
    windows: int
    tracks: int
    folds: Sequence[dict[str, dict[str, float]]] = ()
    learned_from: int = 0


class Errors(NamedTuple):
    """Errors of predictions after each step, NaN where the driver was not seen.

    Attributes:
        distance: from the expected to the recorded position [m].
        log_p: log density of the recorded position [1/m^2].
        level: see `density_level`.
    """

    distance: Steps
    log_p: Steps
    level: Steps


def prediction_errors(mixture: Mixture, recorded: Paths) -> Errors:
    """Compare predicted distributions with recorded positions."""
    positions = recorded.astype(np.float32)
    offsets = expected_path(mixture.modes) - recorded
    return Errors(
        distance=np.linalg.norm(offsets, axis=-1),
        log_p=np.asarray(log_density(mixture, positions)),
        level=density_level(mixture, positions),
    )


def metrics(errors: Errors) -> dict[str, ByHorizon]:
    """Return the metrics of a predictor by name and horizon in seconds.

    They are over the drivers that are seen until then.

    Returns:
        ``fde``, the mean distance at the horizon [m]; ``ade``, the mean distance up to
        the horizon [m]; ``rmse``, the root mean square of the distance at the horizon
        [m]; ``miss``, the share of drivers who are more than 2 m off at the horizon;
        ``log_p``, the mean log density of the recorded positions [1/m^2]; ``inside 50``
        and so on, the share of drivers in the region of highest density that holds 50 %
        of the probability.
    """
    rows: dict[str, ByHorizon] = {}
    for seconds, step in zip(HORIZONS.seconds, HORIZONS.steps, strict=True):
        seen = np.isfinite(errors.distance[:, step])
        if not seen.any():
            continue
        distance = errors.distance[seen, step]
        level = errors.level[seen, step]
        values = {
            "fde": distance.mean(),
            "ade": errors.distance[seen, : step + 1].mean(),
            "rmse": np.sqrt((distance**2).mean()),
            "miss": (distance > MISS).mean(),
            "log_p": errors.log_p[seen, step].mean(),
        }
        for percent in LEVELS:
            values[f"inside {percent}"] = (level < percent / 100).mean()
        for name, value in values.items():
            rows.setdefault(name, {})[str(seconds)] = float(value)
    return rows


def evaluate(
    recordings: Sequence[Recording],
    learned: LearnedDrivers | None = None,
    *,
    parts: int = 4,
    progress: Progress = silent,
) -> Evaluation:
    """Evaluate learned drivers on recordings, or cross-validate.

    A cross-validation learns from the other folds to predict each fold. Drivers that
    are not `ms_highway.irl.usable.usable` are left out, with a warning that names them.

    Args:
        recordings: all recordings; a cross-validation splits them by group, and so by
            driver.
        learned: the drivers; None for a cross-validation.
        parts: number of folds of a cross-validation.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if a peer is missing, a cross-validation has only one fold, or no
            driver was seen for long enough.
    """
    usable, _ = usable_recordings(recordings)
    snapshots = cut_snapshots(usable)
    held_out = folds(snapshots.group, 1 if learned else parts)
    if not learned and len(held_out) < 2:
        raise ValueError(
            "cross-validation needs two folds and recordings of two groups; give more,"
            " or evaluate a theta"
        )

    # The errors of each fold, under drivers that were learned from the others.
    errors_of_folds = []
    regimes_of_folds = []
    weights = []
    for number, chosen in enumerate(held_out, 1):
        some = snapshots.of(chosen)
        progress(
            f"fold {number} of {len(held_out)}, with {some.predicted.sum()} drivers to"
            " predict"
        )
        drivers = learned or learn_drivers(snapshots.only(~chosen), intervals=False)
        weights.append({"drivers": drivers.weights})
        errors_of_folds.append(_errors_by_predictor(some, drivers))
        regimes_of_folds.append(driving_regimes(some))

    # All folds in a row.
    errors = {}
    for name, each in _by_name(errors_of_folds).items():
        errors[name] = Errors(*map(np.concatenate, zip(*each, strict=True)))
    regimes = {}
    for name, flags in _by_name(regimes_of_folds).items():
        regimes[name] = np.concatenate(flags)
    return Evaluation(
        predictors={name: metrics(each) for name, each in errors.items()},
        situations=metrics_by_regime(errors, regimes),
        windows=len(snapshots.which),
        tracks=len(np.unique(snapshots.drivers(snapshots.track))),
        folds=() if learned else weights,
    )


def _errors_by_predictor(
    snapshots: Snapshots,
    drivers: LearnedDrivers,
) -> dict[str, Errors]:
    """Return the errors of all predictors, by name."""
    errors = {}
    for name in PREDICTORS:
        mixture = predict_with(name, snapshots, drivers)
        errors[name] = prediction_errors(mixture, snapshots.recorded)
    return errors


def _by_name(of_folds: Sequence[Mapping[str, Value]]) -> dict[str, list[Value]]:
    """Return the values of all folds by their name, in the order of names."""
    return {name: [of_fold[name] for of_fold in of_folds] for name in of_folds[0]}


def driving_regimes(snapshots: Snapshots) -> dict[str, Flags]:
    """Return which predicted drivers are in each regime, by name.

    A driver may be in several, or in none. *lane change*: moves 1.5 m to the side
    within 3 s. *braking*, *accelerating*: by more than 1 m/s^2 on average over 3 s.
    *slow*: below 5 m/s at the start. *no leader*: nobody within 50 m ahead in the own
    lane at the start. *following*: none of the other regimes. Drivers who are seen for
    less than 3 s are in none.
    """
    start = snapshots.drivers(snapshots.now)
    last_step = SNAPSHOT.steps_per_second * REGIME_LIMITS.seconds - 1
    later = snapshots.drivers(snapshots.future[:, last_step])
    x, y, _, speed = start.T
    _, y_later, _, speed_later = later.T

    # Whether there is a leader in the own lane.
    others = snapshots.now[snapshots.which]  # [drivers, cars, 4]
    half_width = snapshots.lane_width[snapshots.which] / 2
    distance = others[..., 0] - x[:, None]
    is_near = distance < REGIME_LIMITS.leader_distance
    reach = half_width[:, None, None]
    _, is_led = leaders(x[:, None], y[:, None], others, is_near[:, None], reach)

    acceleration = (speed_later - speed) / REGIME_LIMITS.seconds
    regimes = {
        "lane change": np.abs(y_later - y) > REGIME_LIMITS.lane_change,
        "braking": acceleration < -REGIME_LIMITS.acceleration,
        "accelerating": acceleration > REGIME_LIMITS.acceleration,
        "slow": speed < REGIME_LIMITS.slow,
        "no leader": ~is_led[:, 0],
    }
    regimes["following"] = ~np.any(list(regimes.values()), axis=0)
    seen_until_then = np.isfinite(acceleration)
    return {name: chosen & seen_until_then for name, chosen in regimes.items()}


def metrics_by_regime(
    errors: Mapping[str, Errors],
    regimes: Mapping[str, Flags],
) -> Situations:
    """Return the mean distance and log density by regime, predictor and horizon.

    See `Evaluation.situations`.
    """
    situations: Situations = {"distance": {}, "log_p": {}}
    for regime, chosen in regimes.items():
        if not chosen.any():
            continue
        by_predictor = {
            name: metrics(Errors(*(part[chosen] for part in each)))
            for name, each in errors.items()
        }
        distances = errors["model"].distance[chosen][:, HORIZONS.steps]
        numbers = np.isfinite(distances).sum(axis=0).astype(float).tolist()
        windows = dict(zip(map(str, HORIZONS.seconds), numbers, strict=True))
        for kind, metric in (("distance", "fde"), ("log_p", "log_p")):
            situations[kind][regime] = {
                "windows": windows,
                **{name: found[metric] for name, found in by_predictor.items()},
            }
    return situations
