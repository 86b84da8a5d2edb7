"""Learn drivers from where they are seconds later: weights, traits, lane changes and the spread around predictions.

Segments of half a second, see `ms_highway.irl.maximum_entropy`, are mostly noise: the accelerations of recorded cars
waver by more than what drivers want differs. So the weights that matter in a lane are those under which all cars of a
snapshot, driving on together, come closest to where they were recorded 1, 2, 3 and 5 s later.
"""

from itertools import count
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import structs
from scipy import optimize, special

from ms_highway.game.learned_drivers import CHANGING, LEARNED, Drivers, Intention, LearnedDrivers, TraitPrior
from ms_highway.irl.mixture import SIDES, Modes, fit_spread
from ms_highway.irl.prediction import fit_peers, lane_advantages, predict_drivers, roll_out
from ms_highway.irl.recording import CarFlags, CarNumbers, Cars, Flags
from ms_highway.irl.snapshots import AT, SCALES, Snapshots, lane_numbers
from ms_highway.numerics.estimation import Parameters, grouped_covariance, minimum, slope_differences
from ms_highway.planning.learned_driving import shown_traits
from ms_highway.runtime.arrays import Scalar
from ms_highway.runtime.progress import Progress, silent
from ms_highway.runtime.structures import plain

SURE = 20  # steps for which a driver must be seen, to know whether it changes lanes
COMFORT = 0.1
FIRST = {
    **dict(zip(LEARNED, (7e-4, 4e-3, 0.1, 0.1, 0.2, 0.05), strict=True)),
    **{"typical headway": 1.2, "desired speeds": 0.15, "headways": 0.5, "patiences": 0.4, "noise": 0.7},
}  # that the fit starts from, and the medians of its prior: weights, median headway, deviations of traits, and noise
NAMES = (*FIRST, *(f"{name} while changing lanes" for name in CHANGING))
MEDIANS = np.log([*FIRST.values(), *np.ones(len(CHANGING))])  # logarithms of the medians of the prior
WIDE, NARROW = 2.0, 0.7  # standard deviations of the prior, of logarithms of weights and of all else
DEVIATIONS = np.array([WIDE if name in LEARNED else NARROW for name in (*FIRST, *CHANGING)])
ODDS = 3.0  # standard deviation of the prior of an intention's numbers
MOST, REFIT = 60, 10  # iterations of a fit, and from the fit to all drivers to that to some of them
FOLDS = 3  # of recordings, to learn the spread of drivers who were not learned from
DIFFERENCE = 0.02  # of logarithms, for second derivatives in single precision
AT_ONCE = 35  # snapshots, so that gradients fit in memory


class _Labels(NamedTuple):
    """What the drivers of snapshots did afterwards.

    Attributes:
        counts: which drivers are learned from: seen for 2 s, and at last, within 5 s, in their lane or one beside it.
        side: lanes to the right by which these change lanes.
    """

    counts: CarFlags
    side: CarNumbers

    def among(self, chosen: Flags) -> "_Labels":
        """Return the labels of the drivers of some snapshots only."""
        return _Labels(*(part * chosen[:, None] for part in self))


def learn_drivers(
    snapshots: Snapshots, chosen: Flags, intervals: bool = True, progress: Progress = silent
) -> LearnedDrivers:
    """Learn drivers, with the weights `LEARNED` and that of the comfort of acceleration, 0.1, and fit all peers.

    Args:
        snapshots: to learn from.
        chosen: which of them; one compilation serves any choice.
        intervals: whether to compute the drivers' ``deviations``.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for as long as 2 s.
    """
    labels = _label(snapshots).among(chosen)
    if not labels.counts.any():
        raise ValueError(f"no driver was seen for {SURE / 10:g} s on end; nothing can be learned seconds ahead")
    found, drivers = _fit_drivers(snapshots, labels, progress)
    modes = _predict_held_out(snapshots, labels, found, chosen, progress) or predict_drivers(snapshots, drivers)
    spread = fit_spread(modes, np.where(chosen[snapshots.which][:, None, None], snapshots.recorded, np.nan))
    deviations = dict(zip(NAMES, _deviations(found, snapshots, labels), strict=True)) if intervals else {}
    progress("fitting the predictors to compare with")
    peers = fit_peers(snapshots.of(chosen))
    return LearnedDrivers(**structs.asdict(plain(drivers)), spread=spread, deviations=deviations, peers=peers)


def _label(snapshots: Snapshots) -> _Labels:
    y = np.concatenate([snapshots.past[:, -1:], snapshots.future], axis=1)[..., 1]
    seen = np.isfinite(y[:, 1:]).sum(axis=1)
    last = np.take_along_axis(y, seen[:, None], axis=1)[:, 0]
    side = lane_numbers(snapshots.lanes, last) - lane_numbers(snapshots.lanes, y[:, 0])
    counts = snapshots.predicted & (seen >= SURE) & (np.abs(side) <= 1)
    return _Labels(counts, side * counts)


def _fit_drivers(
    snapshots: Snapshots, labels: _Labels, progress: Progress, begin: Parameters = MEDIANS, iterations: int = MOST
) -> tuple[Parameters, Drivers]:
    """Return the logarithms of `FIRST` and of the factors of `CHANGING` that bring drivers closest to the recorded.

    Also return the drivers, with the intentions that make their lane changes most likely.
    """
    number, used = labels.counts.sum(), labels.counts.any(axis=1).sum()
    data, evaluations = jax.device_put(snapshots), count(1)

    def loss(logarithms: Parameters) -> tuple[float, Parameters]:
        progress(f"fitting {used} snapshots seconds ahead, evaluation {next(evaluations)}")
        error, slope = _mean_error(logarithms, data, labels)
        far = (logarithms - MEDIANS) / DEVIATIONS
        prior = far @ far / (2 * number), far / DEVIATIONS / number
        return float(error) + prior[0], np.asarray(slope, dtype=float) + prior[1]

    found = minimum(loss, begin, maxiter=iterations, ftol=1e-6)
    return found, structs.replace(_drivers_of(found), intention=_fit_intention(data, labels))


def _drivers_of(logarithms: Parameters) -> Drivers:
    """Return the drivers of what `_fit_drivers` finds; they keep their lanes."""
    xp = logarithms.__array_namespace__()
    numbers, factors = xp.exp(logarithms[: len(FIRST)]), xp.exp(logarithms[len(FIRST) :])
    headway, *deviations, noise = numbers[len(LEARNED) :]
    prior = TraitPrior(xp.stack([xp.ones_like(headway), headway, xp.ones_like(headway)]), xp.stack(deviations), noise)
    weights = {**dict(zip(LEARNED, numbers, strict=False)), "comfort_acceleration": COMFORT}
    keeping = Intention(np.full(2, -20.0), np.zeros(6))  # type: ignore[arg-type]
    return Drivers(weights, prior, dict(zip(CHANGING, factors, strict=True)), keeping)


@jax.jit
@jax.value_and_grad
def _mean_error(logarithms: Parameters, snapshots: Snapshots, labels: _Labels) -> Scalar:
    """Return the mean error, over drivers and horizons, of drivers who drive on together to where they go."""
    errors, counts = _errors(logarithms, snapshots, labels)
    return errors.sum() / counts.sum()


@jax.jit
@jax.jacfwd
def _scores(logarithms: Parameters, snapshots: Snapshots, labels: _Labels) -> Cars:
    """Return the slopes of every driver's part of `_mean_error` [n, cars, parameters]."""
    errors, counts = _errors(logarithms, snapshots, labels)
    return errors / counts.sum()


def _errors(logarithms: Parameters, snapshots: Snapshots, labels: _Labels) -> tuple[Cars, Cars]:
    """Return the sum of ``sqrt(1 + (e / s)^2) - 1`` of every driver, along and across, and at how many horizons."""
    drivers = _drivers_of(logarithms)

    def one(pair: tuple[Snapshots, _Labels]) -> tuple[Cars, Cars]:
        snapshot, labels = pair
        traits = shown_traits(drivers, snapshot, snapshot.past)
        path = roll_out(drivers, snapshot, traits, labels.side)[AT, :, :2]
        recorded = snapshot.future[AT, :, :2]
        counts = jnp.isfinite(recorded).all(axis=-1) & labels.counts
        error = jnp.where(counts[..., None], path - jnp.nan_to_num(recorded), 0.0) / SCALES[:, None]
        return jnp.sum(jnp.sqrt(1 + error**2) - 1, axis=(0, 2)), counts.sum(axis=0)

    return jax.lax.map(one, (snapshots, labels), batch_size=AT_ONCE)


def _predict_held_out(
    snapshots: Snapshots, labels: _Labels, begin: Parameters, chosen: Flags, progress: Progress
) -> Modes | None:
    """Predict every group of recordings by what is learned from the others; None if there are too few groups.

    The spread around predictions of drivers who were learned from would be too narrow for others.
    """
    groups = np.unique(snapshots.group[chosen])
    if len(groups) < FOLDS:
        return None
    fold, modes = np.searchsorted(groups, snapshots.group) % FOLDS, []
    for number in range(FOLDS):
        _, drivers = _fit_drivers(snapshots, labels.among(fold != number), progress, begin, REFIT)
        modes.append(predict_drivers(snapshots, drivers))
    return snapshots.by_fold(fold, modes)


def _deviations(found: Parameters, snapshots: Snapshots, labels: _Labels) -> list[float]:
    """Return the standard deviations of what was found, with drivers as the independent units.

    They are those of least errors, with the slopes of each driver's errors in all its snapshots, and the Hessian with
    the prior, of finite differences.
    """
    data = jax.device_put(snapshots)
    hessian = slope_differences(lambda logarithms: _mean_error(logarithms, data, labels)[1], found, DIFFERENCE)
    prior = np.diag(1 / DEVIATIONS**2) / labels.counts.sum()
    inverse = np.linalg.pinv((hessian + hessian.T) / 2 + prior, hermitian=True)
    scores = np.asarray(_scores(found, data, labels), dtype=float)[labels.counts]
    return np.sqrt(np.diag(grouped_covariance(inverse, scores, snapshots.track[labels.counts]))).tolist()


def _fit_intention(snapshots: Snapshots, labels: _Labels) -> Intention:
    """Return the most likely intention, of logistic regression with a weak prior."""
    mode = -labels.side[labels.counts] % len(SIDES)
    advantages, exist = (np.asarray(part)[labels.counts] for part in _advantages(snapshots))
    advantages = advantages.astype(float)

    def loss(numbers: Parameters) -> float:
        odds = np.where(exist, numbers[:2] + advantages @ numbers[2:], -np.inf)
        odds = np.concatenate([np.zeros((len(odds), 1)), odds], axis=1)
        likely = odds[np.arange(len(mode)), mode] - special.logsumexp(odds, axis=1)
        return float(numbers @ numbers / (2 * ODDS**2) - likely.sum())

    found = optimize.minimize(loss, np.array([-3.0, -3.0, *np.zeros(6)])).x
    return Intention(found[:2], found[2:])


_advantages = jax.jit(jax.vmap(lane_advantages))
