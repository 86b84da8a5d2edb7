"""Evaluate learned drivers on recordings, beside the peers of
`ms_highway.irl.prediction`.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import msgspec
import numpy as np

from ms_highway.data.learned_drivers import LearnedDrivers
from ms_highway.game.scene import leaders
from ms_highway.irl.mixture import (
    Mixture,
    Steps,
    density_level,
    expected_path,
    log_density,
)
from ms_highway.irl.prediction import PREDICTORS, predict_with
from ms_highway.irl.recording import Flags, Recording, folds, usable_recordings
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.snapshots import AT, HORIZONS, Paths, Snapshots, cut_snapshots
from ms_highway.runtime.process import Progress, silent

MISS = 2.0
"""Distance from which a prediction counts as a miss [m]."""

LEVELS = (50, 90, 99)
"""Percentages of probability in the predicted regions whose calibration is measured."""

REGIME = 3  # s, over which regimes are distinguished
LANE_CHANGE = 1.5  # m to the side
HARD = 1.0  # m/s^2, on average
SLOW = 5.0  # m/s
LEADER = 50.0  # m ahead, from centre to centre

ByHorizon = dict[str, float]
Situations = dict[str, dict[str, dict[str, ByHorizon]]]


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
    folds: Sequence[dict[str, Any]] = ()
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
    distance = np.linalg.norm(expected_path(mixture.modes) - recorded, axis=-1)
    return Errors(
        distance,
        np.asarray(log_density(mixture, positions)),
        density_level(mixture, positions),
    )


def metrics(errors: Errors) -> dict[str, ByHorizon]:
    """Return the metrics of a predictor by name and horizon in seconds, over the
    drivers that are seen until then.

    Returns:
        ``fde``, the mean distance at the horizon [m]; ``ade``, the mean distance up to
        the horizon [m]; ``rmse``, the root mean square of the distance at the horizon
        [m]; ``miss``, the share of drivers who are more than 2 m off at the horizon;
        ``log_p``, the mean log density of the recorded positions [1/m^2]; ``inside 50``
        and so on, the share of drivers in the region of highest density that holds 50 %
        of the probability.
    """
    rows: dict[str, ByHorizon] = {}
    for horizon, at in zip(map(str, HORIZONS), AT, strict=True):
        seen = np.isfinite(errors.distance[:, at])
        if not seen.any():
            continue
        distance, log_p, level = (part[seen, at] for part in errors)
        values = {
            "fde": distance.mean(),
            "ade": errors.distance[seen, : at + 1].mean(),
            "rmse": np.sqrt((distance**2).mean()),
            "miss": (distance > MISS).mean(),
            "log_p": log_p.mean(),
            **{
                f"inside {percent}": (level < percent / 100).mean()
                for percent in LEVELS
            },
        }
        for name, value in values.items():
            rows.setdefault(name, {})[horizon] = float(value)
    return rows


def evaluate(
    recordings: Sequence[Recording],
    learned: LearnedDrivers | None = None,
    *,
    parts: int = 4,
    progress: Progress = silent,
) -> Evaluation:
    """Evaluate learned drivers on recordings; or cross-validate: learn from the other
    folds to predict each fold.

    Drivers that are not `ms_highway.irl.recording.usable` are left out, with a warning
    that names them.

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
    snapshots = cut_snapshots(usable_recordings(recordings)[0])
    held_out = folds(snapshots.group, 1 if learned else parts)
    if not learned and len(held_out) < 2:
        raise ValueError(
            "cross-validation needs two folds and recordings of two groups; give more,"
            " or evaluate a theta"
        )
    results = []
    weights = []
    for number, chosen in enumerate(held_out, 1):
        some = snapshots.of(chosen)
        progress(
            f"fold {number} of {len(held_out)}, with {some.predicted.sum()} drivers to"
            " predict"
        )
        drivers = learned or learn_drivers(snapshots.only(~chosen), intervals=False)
        weights.append({"drivers": drivers.weights})
        errors = {
            name: prediction_errors(predict_with(name, some, drivers), some.recorded)
            for name in PREDICTORS
        }
        results.append((errors, driving_regimes(some)))
    joined, regimes = jax.tree.map(lambda *rows: np.concatenate(rows), *results)
    errors = {
        name: joined[name] for name in PREDICTORS
    }  # jax.tree sorts names by the alphabet
    return Evaluation(
        predictors={name: metrics(each) for name, each in errors.items()},
        situations=metrics_by_regime(
            errors, {name: regimes[name] for name in results[0][1]}
        ),
        windows=len(snapshots.which),
        tracks=len(np.unique(snapshots.drivers(snapshots.track))),
        folds=() if learned else weights,
    )


def driving_regimes(snapshots: Snapshots) -> dict[str, Flags]:
    """Return which predicted drivers are in each regime, by name; a driver may be in
    several, or in none.

    *lane change*: moves 1.5 m to the side within 3 s. *braking*, *accelerating*: by
    more than 1 m/s^2 on average over 3 s. *slow*: below 5 m/s at the start. *no
    leader*: nobody within 50 m ahead in the own lane at the start. *following*: none of
    the other regimes. Drivers who are seen for less than 3 s are in none.
    """
    start = snapshots.drivers(snapshots.now)
    later = snapshots.drivers(snapshots.future[:, 10 * REGIME - 1])
    others = snapshots.now[snapshots.which]
    reach = snapshots.lane_width[snapshots.which] / 2
    near = (others[..., 0] - start[:, :1] < LEADER)[:, None]
    _, led = leaders(start[:, :1], start[:, 1:2], others, near, reach[:, None, None])
    acceleration = (later[:, 3] - start[:, 3]) / REGIME
    found = {
        "lane change": np.abs(later[:, 1] - start[:, 1]) > LANE_CHANGE,
        "braking": acceleration < -HARD,
        "accelerating": acceleration > HARD,
        "slow": start[:, 3] < SLOW,
        "no leader": ~led[:, 0],
    }
    found["following"] = ~np.any(list(found.values()), axis=0)
    return {name: chosen & np.isfinite(acceleration) for name, chosen in found.items()}


def metrics_by_regime(
    errors: dict[str, Errors], regimes: dict[str, Flags]
) -> Situations:
    """Return the mean distance and log density by regime, predictor and horizon, see
    `Evaluation.situations`.
    """
    rows: Situations = {"distance": {}, "log_p": {}}
    for regime, chosen in regimes.items():
        if chosen.any():
            found = {
                name: metrics(Errors(*(part[chosen] for part in each)))
                for name, each in errors.items()
            }
            seen = (
                np.isfinite(errors["model"].distance[chosen][:, AT])
                .sum(axis=0)
                .astype(float)
                .tolist()
            )
            windows = dict(zip(map(str, HORIZONS), seen, strict=True))
            for kind, metric in (("distance", "fde"), ("log_p", "log_p")):
                rows[kind][regime] = {
                    "windows": windows,
                    **{name: each[metric] for name, each in found.items()},
                }
    return rows
