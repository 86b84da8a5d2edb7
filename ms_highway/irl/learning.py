"""Learn a reward from recordings.

Cut them into segments, fit the weights, cross-validate, and compare feature counts.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from typing import NamedTuple

import jax
import numpy as np

from ms_highway.data.learned_reward import LearnedReward
from ms_highway.game.dynamics import keep_velocity, observe
from ms_highway.game.game import Game
from ms_highway.game.reward import COMFORT, RewardModel
from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.irl import REAL_WEIGHTS, SIMULATED_WEIGHTS
from ms_highway.irl.demonstrator import optimal
from ms_highway.irl.maximum_entropy import (
    DivergenceError,
    FeatureDerivatives,
    Fit,
    differentiate,
    fit_weights,
    segment_log_likelihoods,
)
from ms_highway.irl.recording import Controls, Flags, Recording, folds, sources
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.segments import Segments, cut_segments, driver_game, with_segment
from ms_highway.irl.snapshots import cut_snapshots
from ms_highway.irl.usable import listed, usable_recordings
from ms_highway.runtime.arrays import Vector
from ms_highway.runtime.compilation import in_batches, jit_quickly
from ms_highway.runtime.process import Progress, silent

COMFORT_GIVEN = 0.1
"""Given comfort weight, which sets the scale of all others; small against the curvature
of the published weights.
"""

SIMULATED = RewardModel(
    SIMULATED_WEIGHTS,
    {"off_road": COMMON_WEIGHTS["off_road"], **dict.fromkeys(COMFORT, COMFORT_GIVEN)},
)
"""The model for simulated demonstrations: it learns the weights that every driver in
the paper has.

The weight of leaving the road is given, as it cannot be learned: the feature is 0 on
the road, and segments along the road's edge are left out, see
`ms_highway.irl.segments.regular`.
"""

REAL = RewardModel(REAL_WEIGHTS, {"comfort_acceleration": COMFORT_GIVEN}, tails=True)
"""The model for real drivers: it also learns weights of interaction with traffic, and
of comfort in steering.
"""


def learn_reward(
    recordings: Sequence[Recording],
    model: RewardModel,
    horizon: int,
    source: str,
    validations: int = 4,
    *,
    progress: Progress = silent,
) -> LearnedReward:
    """Learn a reward from all drivers of the recordings.

    From measured recordings, also learn drivers seconds ahead. Drivers that are not
    `ms_highway.irl.usable.usable` are left out, with a warning that names them. Where a
    driver never steers or never changes its speed, its controls are exactly the best
    ones, and weights may grow without bound. Only if they do, these segments are left
    out as well, with a warning.

    Args:
        recordings: the recordings to learn from.
        model: the weights to learn and those given.
        horizon: K, the length of the segments in steps.
        source: name of the data, for the provenance.
        validations: number of folds of the cross-validated likelihood.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver is usable, no segment is regular, the weights diverge,
            a fit does not converge, or `learn_drivers` fails.
    """
    recordings, left_out = usable_recordings(recordings)
    real = recordings[0].measured

    # The weights.
    progress("cutting segments")
    segments = cut_segments(recordings, horizon)
    progress(f"differentiating {len(segments)} segments")
    derivatives = differentiate(segments, model.names)
    progress("fitting")
    every_segment = SegmentData(segments, derivatives)
    data, found, reasons = _fit_to_changing(every_segment, model, recordings)
    left_out |= reasons
    held_out = _cross_validate(data, found, validations, progress)

    # What drivers do seconds later, and in one segment.
    drivers = None
    if real:
        drivers = learn_drivers(cut_snapshots(recordings), progress=progress)
    progress("counting features")
    feature_counts = {
        "human": _by_feature(model, data.derivatives.features.mean(axis=0)),
        "model": _by_feature(model, expected_features(data.segments, found)),
    }
    return LearnedReward(
        weights=found.weights,
        temperature=found.temperature,
        learned=model.learned,
        covariance=found.covariance.tolist(),
        horizon=horizon,
        converged=True,
        iterations=found.iterations,
        windows=len(data.segments),
        log_likelihood={"train": found.log_likelihood, "held_out": held_out},
        feature_counts=feature_counts,
        provenance=_provenance(recordings, source, left_out),
        tails=found.tails,
        drivers=drivers,
        learned_from=sources(recordings),
    )


class SegmentData(NamedTuple):
    """Segments and the derivatives of their features.

    Attributes:
        segments: of all drivers.
        derivatives: of the features of each segment.
    """

    segments: Segments
    derivatives: FeatureDerivatives


def _by_feature(model: RewardModel, sums: Vector) -> dict[str, float]:
    """Return sums of features by the features' names."""
    return dict(zip(model.names, sums.tolist(), strict=True))


def _fit_to_changing(
    data: SegmentData,
    model: RewardModel,
    recordings: Sequence[Recording],
) -> tuple[SegmentData, Fit, dict[str, str]]:
    """Fit the weights; if they diverge, to segments in which driving changes.

    Returns:
        The segments that were learned from; the fit; and why drivers have segments that
        are left out, by name.
    """
    real = recordings[0].measured
    try:
        return data, _fit(data, model, real), {}
    except DivergenceError as error:
        changing, reasons = _without_steady(data, recordings, error)
        return changing, _fit(changing, model, real), reasons


def _fit(data: SegmentData, model: RewardModel, real: bool) -> Fit:
    """Fit the weights.

    The independent units are drivers if they are real, and segments if they are
    simulated.
    """
    drivers = data.segments.driver if real else None
    return fit_weights(data.derivatives, model, drivers=drivers)


def _without_steady(
    data: SegmentData,
    recordings: Sequence[Recording],
    error: DivergenceError,
) -> tuple[SegmentData, dict[str, str]]:
    """Leave out segments in which the speed or the heading does not change at all.

    Args:
        data: all segments.
        recordings: from which they were cut.
        error: why the weights could not be learned from all segments.

    Returns:
        The other segments; and why drivers have segments that are left out, by name.

    Raises:
        ValueError: if there are no such segments, or no others.
    """
    segments = data.segments
    labels = [
        f"{recording.label(car)} of {recording.name}"
        for recording in recordings
        for car in recording.drivers
    ]
    steady = keeps_velocity(segments)
    if not steady.any():
        driver = labels[segments.driver[error.likeliest]]
        raise ValueError(
            f"the weights cannot be learned: {error.what} without bound, because"
            f" the driving of {driver} fits them perfectly; leave this driver out,"
            " learn fewer weights, or learn from more driving"
        ) from error
    steady_drivers = segments.driver[steady]
    names = list(dict.fromkeys(labels[driver] for driver in steady_drivers))
    if steady.all():
        raise ValueError(
            f"nothing can be learned from {listed(names)}: no driver ever steers,"
            " or none changes its speed"
        ) from error
    warnings.warn(
        f"{steady.sum()} of {len(segments)} segments are left out, in which the"
        f" speed or the heading does not change at all ({listed(names)}): with"
        f" them, {error.what} without bound",
        stacklevel=4,
    )
    reason = "has segments in which its speed or heading does not change at all"
    changing = SegmentData(segments.of(~steady), data.derivatives.of(~steady))
    return changing, dict.fromkeys(names, reason)


def _cross_validate(
    data: SegmentData,
    found: Fit,
    validations: int,
    progress: Progress,
) -> float | None:
    """Return the mean log likelihood of segments that were not learned from.

    Each fold has its own groups; the result is None with a single group.

    Args:
        data: all segments.
        found: the fit to all of them.
        validations: number of folds.
        progress: called with a message when a fold begins.
    """
    parts = folds(data.segments.group, validations)
    if len(parts) < 2:
        return None
    held_out = list[float]()
    for number, chosen in enumerate(parts, 1):
        progress(f"cross-validating, {number} of {len(parts)}")
        of_others = fit_weights(data.derivatives.of(~chosen), found.model, found)
        some = data.derivatives.of(chosen)
        held_out += segment_log_likelihoods(some, of_others).tolist()
    return float(np.mean(held_out))


def _provenance(
    recordings: Sequence[Recording],
    source: str,
    left_out: Mapping[str, str],
) -> dict[str, object]:
    """Return where a learned reward comes from."""
    packages = ("ms-highway", "jax", "numpy", "scipy")
    provenance: dict[str, object] = {
        "data": source,
        "groups": len({recording.group for recording in recordings}),
        "drivers": sum(len(recording.drivers) for recording in recordings),
        "versions": {package: version(package) for package in packages},
    }
    if left_out:
        provenance["left_out"] = left_out
    return provenance


def keeps_velocity(segments: Segments) -> Flags:
    """Return in which segments a driver keeps its speed, or its heading, exactly.

    Controls that differ by less than 1e-4 of the planner's scale from those that keep
    the velocity are no choice. In SI units, this is 3 mm/s^2; recorded accelerations
    waver by more than 100.
    """
    smallest_choice = 1e-4
    game = driver_game(segments, {})
    keeping = jax.vmap(partial(keep_velocity, game.dynamics))(segments.start)
    scale = np.asarray(game.planner.control_scale)
    deviations = np.abs(segments.controls - keeping[:, None]) / scale
    return (deviations.max(axis=1) < smallest_choice).any(axis=-1)


@jit_quickly
@partial(jax.vmap, in_axes=(None, 0))
def best_controls(game: Game, segment: Segments) -> Controls:
    """Return the unscaled controls of a local optimum in each segment.

    The weights are those of a `driver_game`.
    """
    best = optimal(with_segment(game, segment), segment.start, observe(segment.others))
    return best.controls * game.planner.control_scale


def expected_features(segments: Segments, found: Fit) -> Vector:
    """Return the sums of features over a segment that a fit expects.

    They are means over the segments, to second order around the best controls u*:
    ``phi(u*) + tr(H_phi S) / 2`` with ``S = T (-H)^-1``, where the eigenvalues of -H
    are bounded as in the fit.
    """
    model = found.model
    temperature = found.temperature

    # The derivatives at the best controls u*.
    sharp = {name: weight / temperature for name, weight in found.weights.items()}
    best = in_batches(partial(best_controls, driver_game(segments, sharp)), segments)
    derivatives = differentiate(replace(segments, controls=best), model.names)

    # S, from the eigenvalues of -H / T.
    theta = np.array([found.weights[name] for name in model.names])
    hessians = np.einsum("f,nfde->nde", theta, derivatives.hessians)
    values, vectors = np.linalg.eigh(-hessians / temperature)
    values = np.maximum(values, model.floor / temperature)
    spread = np.einsum("nde,ne,nfe->ndf", vectors, 1 / values, vectors)

    traces = np.einsum("nfde,nde->nf", derivatives.hessians, spread)
    return np.mean(derivatives.features + traces / 2, axis=0)
