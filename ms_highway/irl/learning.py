"""Learn a reward from recordings: cut them into segments, fit the weights,
cross-validate, compare feature counts.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version

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
    Fit,
    differentiate,
    fit_weights,
    segment_log_likelihoods,
)
from ms_highway.irl.recording import (
    Controls,
    Flags,
    Recording,
    folds,
    listed,
    sources,
    usable_recordings,
)
from ms_highway.irl.seconds_ahead import learn_drivers
from ms_highway.irl.segments import Segments, cut_segments, driver_game, with_segment
from ms_highway.irl.snapshots import cut_snapshots
from ms_highway.runtime.arrays import Vector
from ms_highway.runtime.compilation import in_batches, jit_quickly
from ms_highway.runtime.process import Progress, silent

COMFORT_GIVEN = 0.1
"""Given comfort weight, which sets the scale of all others; small against the curvature
of the published weights.
"""

STEADY = 1e-4
"""Controls that differ by less than this part of the planner's scale from those that
keep the velocity are no choice.

In SI units, this is 3 mm/s^2; recorded accelerations waver by more than 100.
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
    """Learn a reward from all drivers of the recordings; from measured recordings, also
    learn drivers seconds ahead.

    Drivers that are not `ms_highway.irl.recording.usable` are left out, with a warning
    that names them. Where a driver never steers or never changes its speed, its
    controls are exactly the best ones, and weights may grow without bound. Only if they
    do, these segments are left out as well, with a warning.

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
    progress("cutting segments")
    segments = cut_segments(recordings, horizon)
    progress(f"differentiating {len(segments)} segments")
    derivatives = differentiate(segments, model.names)
    progress("fitting")
    real = recordings[0].measured
    labels = [
        f"{label} of {each.name}"
        for each in recordings
        for label in map(each.label, each.drivers)
    ]
    try:
        found = fit_weights(
            derivatives, model, drivers=segments.driver if real else None
        )
    except DivergenceError as error:
        steady = keeps_velocity(segments)
        if not steady.any():
            driver = labels[segments.driver[error.likeliest]]
            raise ValueError(
                f"the weights cannot be learned: {error.what} without bound, because"
                f" the driving of {driver} fits them perfectly; leave this driver out,"
                " learn fewer weights, or learn from more driving"
            ) from error
        names = list(
            dict.fromkeys(labels[driver] for driver in segments.driver[steady])
        )
        if steady.all():
            raise ValueError(
                f"nothing can be learned from {listed(names)}: no driver ever steers,"
                " or none changes its speed"
            ) from error
        left_out |= dict.fromkeys(
            names, "has segments in which its speed or heading does not change at all"
        )
        warnings.warn(
            f"{steady.sum()} of {len(segments)} segments are left out, in which the"
            f" speed or the heading does not change at all ({listed(names)}): with"
            f" them, {error.what} without bound",
            stacklevel=2,
        )
        segments = segments.of(~steady)
        derivatives = derivatives.of(~steady)
        found = fit_weights(
            derivatives, model, drivers=segments.driver if real else None
        )
    held_out = list[float]()
    parts = folds(segments.group, validations)
    for number, chosen in enumerate(parts if len(parts) > 1 else [], 1):
        progress(f"cross-validating, {number} of {len(parts)}")
        rest = fit_weights(derivatives.of(~chosen), model, found)
        held_out += segment_log_likelihoods(derivatives.of(chosen), rest).tolist()
    drivers = (
        learn_drivers(cut_snapshots(recordings), progress=progress) if real else None
    )
    progress("counting features")
    counts = {
        "human": derivatives.features.mean(axis=0),
        "model": expected_features(segments, found),
    }
    return LearnedReward(
        weights=found.weights,
        temperature=found.temperature,
        learned=model.learned,
        covariance=found.covariance.tolist(),
        horizon=horizon,
        converged=True,
        iterations=found.iterations,
        windows=len(segments),
        log_likelihood={
            "train": found.log_likelihood,
            "held_out": float(np.mean(held_out)) if held_out else None,
        },
        feature_counts={
            who: dict(zip(model.names, sums.tolist(), strict=True))
            for who, sums in counts.items()
        },
        provenance={
            "data": source,
            "groups": len({recording.group for recording in recordings}),
            "drivers": sum(len(recording.drivers) for recording in recordings),
            "versions": {
                package: version(package)
                for package in ("ms-highway", "jax", "numpy", "scipy")
            },
            **({"left_out": left_out} if left_out else {}),
        },
        tails=found.tails,
        drivers=drivers,
        learned_from=sources(recordings),
    )


def keeps_velocity(segments: Segments) -> Flags:
    """Return in which segments a driver keeps its speed, or its heading, exactly."""
    game = driver_game(segments, {})
    steady = jax.vmap(partial(keep_velocity, game.dynamics))(segments.start)[:, None]
    deviations = np.abs(segments.controls - steady) / np.asarray(
        game.planner.control_scale
    )
    return (deviations.max(axis=1) < STEADY).any(axis=-1)


@jit_quickly
@partial(jax.vmap, in_axes=(None, 0))
def best_controls(game: Game, segment: Segments) -> Controls:
    """Return the unscaled controls of a local optimum in each segment under the weights
    of a `driver_game`.
    """
    best = optimal(with_segment(game, segment), segment.start, observe(segment.others))
    return best.controls * game.planner.control_scale


def expected_features(segments: Segments, found: Fit) -> Vector:
    """Return the expected sums of the features over a segment under the fit's
    distribution of controls.

    They are means over the segments, to second order around the best controls u*:
    ``phi(u*) + tr(H_phi S) / 2`` with ``S = T (-H)^-1``, where the eigenvalues of -H
    are bounded as in the fit.
    """
    sharp = {name: weight / found.temperature for name, weight in found.weights.items()}
    best = in_batches(partial(best_controls, driver_game(segments, sharp)), segments)
    derivatives = differentiate(replace(segments, controls=best), found.model.names)
    theta = np.array([found.weights[name] for name in found.model.names])
    values, vectors = np.linalg.eigh(
        -np.einsum("f,nfde->nde", theta, derivatives.hessians) / found.temperature
    )
    values = np.maximum(values, found.model.floor / found.temperature)
    spread = np.einsum("nde,ne,nfe->ndf", vectors, 1 / values, vectors)
    return np.mean(
        derivatives.features
        + np.einsum("nfde,nde->nf", derivatives.hessians, spread) / 2,
        axis=0,
    )
