"""Learn drivers from where they are seconds later.

What is learned are weights, traits, lane changes and the spread around predictions.
Segments of half a second (`ms_highway.irl.maximum_entropy`) are mostly noise: recorded
accelerations waver by more than drivers' preferences differ. The weights that matter in
a lane are therefore those under which all cars of a snapshot, driving on together, come
closest to where they were recorded 1, 2, 3 and 5 s later.

A fit is over the logarithms of the drivers' numbers, in the order of `DriverPrior`:
weights, the median headway, the deviations of traits, noise, and factors while changing
lanes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import ClassVar

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import structs
from scipy import optimize, special

from ms_highway.data.learned_drivers import (
    Drivers,
    Intention,
    LearnedDrivers,
    TraitPrior,
)
from ms_highway.geometry.curve import namespace
from ms_highway.irl.driving import lane_indices, roll_out, shown_traits
from ms_highway.irl.horizons import robust_errors
from ms_highway.irl.mixture import SIDES, fit_spread
from ms_highway.irl.peers import fit_peers
from ms_highway.irl.prediction import lane_advantages, predict_drivers
from ms_highway.irl.recording import CarFlags, CarNumbers, Cars
from ms_highway.irl.snapshots import SNAPSHOT, Snapshots
from ms_highway.numerics.estimation import (
    Parameters,
    grouped_covariance,
    minimum,
    slope_differences,
)
from ms_highway.runtime.arrays import Scalar, plain
from ms_highway.runtime.process import Progress, silent


@dataclass(frozen=True)
class DriverPrior:
    """Hold the prior of drivers: log-normal distributions of positive numbers.

    They are independent.
    """

    while_changing: ClassVar[str] = " while changing lanes"
    """End of the names of factors."""

    weights: Mapping[str, float] = field(
        default_factory=lambda: dict(
            zip(Drivers.learned_weights, (7e-4, 4e-3, 0.1, 0.1, 0.2, 0.05), strict=True)
        )
    )
    """Medians of the weights, relative to that of the comfort of acceleration, 0.1."""
    traits: Mapping[str, float] = field(
        default_factory=lambda: {
            "typical headway": 1.2,
            "desired speeds": 0.15,
            "headways": 0.5,
            "patiences": 0.4,
            "noise": 0.7,
        }
    )
    """Medians of the typical headway [s], of the standard deviations of traits'
    logarithms, and of the noise of accelerations [m/s^2].
    """
    weight_deviation: float = 2.0
    """Standard deviation of the logarithms of weights and of their factors."""
    trait_deviation: float = 0.7
    """Standard deviation of all other logarithms."""
    odds_deviation: float = 3.0
    """Standard deviation of the numbers of an intention, which are normal around 0."""

    @property
    def medians(self) -> dict[str, float]:
        """Medians of all numbers, by name; those of factors are 1."""
        factors = {name + self.while_changing: 1.0 for name in Drivers.in_lane_changes}
        return {**self.weights, **self.traits, **factors}

    @property
    def means(self) -> Parameters:
        """Means of the logarithms, from which a fit starts."""
        return np.log(list(self.medians.values()))

    @property
    def deviations(self) -> Parameters:
        """Standard deviations of the logarithms."""
        of_weights = [
            name.removesuffix(self.while_changing) in Drivers.learned_weights
            for name in self.medians
        ]
        return np.where(of_weights, self.weight_deviation, self.trait_deviation)


DRIVER_PRIOR = DriverPrior()


@dataclass(frozen=True)
class DriverFit:
    """Set how drivers are fitted to recordings."""

    comfort_weight: float = 0.1
    """Given weight of the comfort of acceleration: it sets the scale of all others."""
    min_steps: int = 20
    """Steps for which a driver must be seen, to know whether it changes lanes: 2 s."""
    iterations: int = 60
    """Iterations of the fit to all drivers."""
    refit_iterations: int = 10
    """Iterations of a fit to some drivers, which starts from the fit to all."""
    folds: int = 3
    """Folds of recordings, to learn the spread of drivers who were not learned from."""
    difference: float = 0.02
    """Difference of logarithms for second derivatives, in single precision."""
    batch_size: int = 35
    """Snapshots that are computed at once, so that gradients fit in memory."""


DRIVER_FIT = DriverFit()


def learn_drivers(
    snapshots: Snapshots,
    intervals: bool = True,
    progress: Progress = silent,
) -> LearnedDrivers:
    """Learn drivers seconds ahead, and fit all peers.

    The weight of the comfort of acceleration is given, 0.1; `Drivers.learned_weights`
    are learned relative to it.

    Args:
        snapshots: to learn from; their number sets the shapes for which functions are
            compiled, see `Snapshots.only`.
        intervals: whether to compute the drivers' ``deviations``.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for 2 s.
    """
    learned_from, _ = _labels(snapshots)
    if not np.any(learned_from):
        seconds = DRIVER_FIT.min_steps / SNAPSHOT.steps_per_second
        raise ValueError(
            f"no driver was seen for {seconds:g} s; nothing can be learned seconds"
            " ahead"
        )
    logarithms, drivers = _fit_drivers(
        snapshots, progress, DRIVER_PRIOR.means, iterations=DRIVER_FIT.iterations
    )

    # The spread around predictions of drivers who were not learned from.
    predicted = [
        (predict_drivers(some, fitted), some.recorded)
        for some, fitted in _held_out(snapshots, progress, logarithms, drivers)
    ]
    modes, positions = jax.tree.map(lambda *rows: np.concatenate(rows), *predicted)
    spread = fit_spread(modes, positions)

    deviations: dict[str, float] = {}
    if intervals:
        found = _deviations(logarithms, snapshots)
        deviations = dict(zip(DRIVER_PRIOR.medians, found, strict=True))
    progress("fitting the predictors to compare with")
    return LearnedDrivers(
        **structs.asdict(plain(drivers)),
        spread=spread,
        deviations=deviations,
        peers=fit_peers(snapshots),
    )


def _held_out(
    snapshots: Snapshots,
    progress: Progress,
    logarithms: Parameters,
    drivers: Drivers,
) -> list[tuple[Snapshots, Drivers]]:
    """Return the snapshots of each fold, with drivers learned from the others.

    With fewer groups than folds, return all snapshots with the drivers that were
    learned from them; the spread is then too narrow for other drivers.

    Args:
        snapshots: all of them.
        progress: called with a message when a part begins.
        logarithms: of the drivers that were learned from all snapshots.
        drivers: that were learned from all snapshots.
    """
    groups = np.unique(snapshots.group[snapshots.which])
    if len(groups) < DRIVER_FIT.folds:
        return [(snapshots, drivers)]
    fold = np.searchsorted(groups, snapshots.group) % DRIVER_FIT.folds
    iterations = DRIVER_FIT.refit_iterations
    held_out = []
    for number in range(DRIVER_FIT.folds):
        others = snapshots.only(fold != number)
        _, fitted = _fit_drivers(others, progress, logarithms, iterations)
        held_out.append((snapshots.of(fold == number), fitted))
    return held_out


def _fit_drivers(
    snapshots: Snapshots,
    progress: Progress,
    first: Parameters,
    iterations: int,
) -> tuple[Parameters, Drivers]:
    """Return the logarithms of the drivers that come closest, and these drivers.

    The drivers have the intention that makes their lane changes most likely.

    Args:
        snapshots: to learn from.
        progress: called with a message before each evaluation.
        first: logarithms to start from.
        iterations: of the optimiser, at most.
    """
    learned_from, _ = _labels(snapshots)
    number = learned_from.sum()
    used = learned_from.any(axis=1).sum()
    data = jax.device_put(snapshots)
    evaluations = count(1)
    means = DRIVER_PRIOR.means
    deviations = DRIVER_PRIOR.deviations

    def loss(logarithms: Parameters) -> tuple[float, Parameters]:
        """Return minus the log posterior per driver, and its slope."""
        progress(
            f"fitting {used} snapshots seconds ahead, evaluation {next(evaluations)}"
        )
        error, slope = _mean_error(logarithms, data)
        standard = (logarithms - means) / deviations
        prior = standard @ standard / (2 * number)
        prior_slope = standard / deviations / number
        return float(error) + prior, np.asarray(slope, dtype=float) + prior_slope

    logarithms = minimum(loss, first, maxiter=iterations, ftol=1e-6)
    keeping_lanes = _drivers_of(logarithms)
    drivers = structs.replace(keeping_lanes, intention=_fit_intention(data))
    return logarithms, drivers


def _drivers_of(logarithms: Parameters) -> Drivers:
    """Return the drivers with these logarithms, who keep their lanes."""
    xp = namespace(logarithms)
    end_of_weights = len(DRIVER_PRIOR.weights)
    end_of_traits = end_of_weights + len(DRIVER_PRIOR.traits)
    ends = [end_of_weights, end_of_traits]
    weights, traits, factors = xp.split(xp.exp(logarithms), ends)
    headway, *deviations, noise = traits
    one = xp.ones_like(headway)  # median share of the speed limit, and patience
    prior = TraitPrior(xp.stack([one, headway, one]), xp.stack(deviations), noise)
    by_name = dict(zip(Drivers.learned_weights, weights, strict=True))
    by_name["comfort_acceleration"] = DRIVER_FIT.comfort_weight
    while_changing = dict(zip(Drivers.in_lane_changes, factors, strict=True))
    never = Intention(np.full(2, -20.0), np.zeros(6))  # type: ignore[arg-type]
    return Drivers(by_name, prior, while_changing, never)


def _label(snapshot: Snapshots) -> tuple[CarFlags, CarNumbers]:
    """Return which cars of a snapshot are learned from, and their lane changes.

    A lane change is a number of lanes to the right. A driver to predict is learned from
    if it is seen for 2 s, and if its last position within 5 s is in its own lane or in
    a lane beside it.
    """
    y = jnp.concatenate([snapshot.past[-1:], snapshot.future])[..., 1]  # [times, cars]
    seen = jnp.isfinite(y[1:]).sum(axis=0)
    last = jnp.take_along_axis(y, seen[None], axis=0)[0]
    last_lane = lane_indices(snapshot.lanes, last)
    side = last_lane - lane_indices(snapshot.lanes, y[0])
    is_beside = jnp.abs(side) <= 1
    is_known = (seen >= DRIVER_FIT.min_steps) & is_beside
    learned_from = snapshot.predicted & is_known
    return learned_from, side * learned_from


_labels = jax.jit(jax.vmap(_label))


@jax.jit
@jax.value_and_grad
def _mean_error(logarithms: Parameters, snapshots: Snapshots) -> Scalar:
    """Return the mean of `robust_errors` in a joint simulation.

    Each driver aims at its recorded lane.
    """
    return _shares(logarithms, snapshots).sum()


def _shares(logarithms: Parameters, snapshots: Snapshots) -> Cars:
    """Return every driver's share [n, cars] of the mean error."""
    drivers = _drivers_of(logarithms)

    def errors_of(snapshot: Snapshots) -> tuple[Cars, Cars]:
        """Return the sum of each car's errors, and their number."""
        learned_from, side = _label(snapshot)
        traits = shown_traits(drivers, snapshot)
        path = roll_out(drivers, snapshot, traits, side)[..., :2]
        errors, known = robust_errors(path, snapshot.future, learned_from)
        return jnp.sum(errors, axis=(0, 2)), known.sum(axis=0)

    errors, known = jax.lax.map(errors_of, snapshots, batch_size=DRIVER_FIT.batch_size)
    return errors / known.sum()


# Slopes of every driver's share [n, cars, parameters].
_scores = jax.jit(jax.jacfwd(_shares))


def _deviations(logarithms: Parameters, snapshots: Snapshots) -> list[float]:
    """Return the standard deviations of the logarithms that were found.

    Drivers are the independent units. The scores are the slopes of each driver's errors
    in all its snapshots; the Hessian, with the prior, is by finite differences.
    """
    data = jax.device_put(snapshots)
    learned_from = np.asarray(_labels(snapshots)[0])

    def slope(logarithms: Parameters) -> jax.Array:
        return _mean_error(logarithms, data)[1]

    # The inverse of the Hessian, with the prior.
    hessian = slope_differences(slope, logarithms, DRIVER_FIT.difference)
    symmetric = (hessian + hessian.T) / 2
    prior = np.diag(1 / DRIVER_PRIOR.deviations**2) / learned_from.sum()
    inverse = np.linalg.pinv(symmetric + prior, hermitian=True)

    # The scores of each driver.
    scores = np.asarray(_scores(logarithms, data), dtype=float)[learned_from]
    tracks = np.asarray(snapshots.track)[learned_from]
    covariance = grouped_covariance(inverse, scores, tracks)
    return np.sqrt(np.diag(covariance)).tolist()


def _fit_intention(snapshots: Snapshots) -> Intention:
    """Return the most likely intention by logistic regression with a weak prior."""
    learned_from, side = map(np.asarray, _labels(snapshots))
    mode = -side[learned_from] % len(SIDES)
    advantages, exist = (
        np.asarray(part, dtype=float)[learned_from] for part in _advantages(snapshots)
    )
    drivers = np.arange(len(mode))

    def loss(numbers: Parameters) -> float:
        """Return minus the log posterior, given the biases and the weights."""
        biases = numbers[:2]
        weights = numbers[2:]
        odds = np.where(exist, biases + advantages @ weights, -np.inf)
        odds = np.pad(odds, ((0, 0), (1, 0)))  # of keeping the lane: 0
        totals = special.logsumexp(odds, axis=1)
        log_likelihoods = odds[drivers, mode] - totals
        prior = numbers @ numbers / (2 * DRIVER_PRIOR.odds_deviation**2)
        return float(prior - log_likelihoods.sum())

    first = np.array([-3.0, -3.0, *np.zeros(6)])
    numbers = optimize.minimize(loss, first).x
    return Intention(numbers[:2], numbers[2:])


_advantages = jax.jit(jax.vmap(lane_advantages))
