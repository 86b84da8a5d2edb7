"""Learn drivers from where they are seconds later: weights, traits, lane changes and the spread around predictions.

Windows of half a second, see `ms_highway.irl.maximum_entropy`, are mostly noise: the accelerations of recorded cars
waver by more than what drivers want differs. So the weights that matter in a lane are those under which all cars of a
moment, driving on together, come closest to where they were recorded 1, 2, 3 and 5 s later.
"""

from itertools import count
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import structs
from scipy import optimize, special

from ms_highway.game.learned_drivers import CHANGING, LEARNED, Drivers, Intention, LearnedDrivers, TraitPrior
from ms_highway.irl.arrays import CarFlags, CarNumbers, Cars, Flags, Parameters, Scalar
from ms_highway.irl.driving import drive_on, lane_advantages, predict
from ms_highway.irl.moments import AT, SCALES, Moments, lanes_of
from ms_highway.irl.outlook import SIDES, Modes, fit_spread
from ms_highway.irl.predictors import learn_peers
from ms_highway.numerics.estimation import grouped_covariance, minimum, slope_differences
from ms_highway.planning.learned_driving import shown_traits
from ms_highway.runtime.progress import Progress, silent
from ms_highway.runtime.structures import plain

SURE = 20  # steps for which a driver must be seen, to know whether it changes lanes
COMFORT = 0.1
FIRST = {
    **dict(zip(LEARNED, (7e-4, 4e-3, 0.1, 0.1, 0.2, 0.05), strict=True)),
    **{"typical headway": 1.2, "desired speeds": 0.15, "headways": 0.5, "patiences": 0.4, "noise": 0.7},
}  # that the fit starts from, and the medians of its prior: weights, median headway, deviations of traits, and noise
NAMES = (*FIRST, *(f"{name} while changing lanes" for name in CHANGING))
WIDE, NARROW = 2.0, 0.7  # standard deviations of the prior, of logarithms of weights and of all else
DEVIATIONS = np.array([WIDE if name in LEARNED else NARROW for name in (*FIRST, *CHANGING)])
ODDS = 3.0  # standard deviation of the prior of an intention's numbers
MOST, REFIT = 60, 10  # iterations of a fit, and from the fit to all drivers to that to some of them
FOLDS = 3  # of recordings, to learn the spread of drivers who were not learned from
DIFFERENCE = 0.02  # of logarithms, for second derivatives in single precision
AT_ONCE = 35  # moments, so that gradients fit in memory


class _Known(NamedTuple):
    """What is known of the drivers of moments after the fact.

    Attributes:
        counts: which drivers are learned from: seen for 2 s, and at last, within 5 s, in their lane or one beside it.
        side: lanes to the right by which these change lanes.
    """

    counts: CarFlags
    side: CarNumbers

    def among(self, chosen: Flags) -> "_Known":
        """Return what is known of the drivers of some moments only."""
        return _Known(self.counts & chosen[:, None], self.side * chosen[:, None])


def learn_drivers(
    moments: Moments, chosen: Flags, intervals: bool = True, progress: Progress = silent
) -> LearnedDrivers:
    """Learn drivers, with the weights `LEARNED` and that of the comfort of acceleration, 0.1, and fit all peers.

    Args:
        moments: to learn from.
        chosen: which of them; one compilation serves any choice.
        intervals: whether to compute the drivers' ``deviations``.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for as long as 2 s.
    """
    known = _afterwards(moments).among(chosen)
    if not known.counts.any():
        raise ValueError(f"no driver was seen for {SURE / 10:g} s on end; nothing can be learned seconds ahead")
    found, drivers = _fit_drivers(moments, known, progress)
    modes = _predict_unknown(moments, known, found, chosen, progress) or predict(moments, drivers)
    spread = fit_spread(modes, np.where(chosen[moments.which][:, None, None], moments.recorded, np.nan))
    deviations = dict(zip(NAMES, _deviations(found, moments, known), strict=True)) if intervals else {}
    progress("fitting the predictors to compare with")
    peers = learn_peers(moments.of(chosen))
    return LearnedDrivers(**structs.asdict(plain(drivers)), spread=spread, deviations=deviations, peers=peers)


def _afterwards(moments: Moments) -> _Known:
    y, now = moments.future[..., 1], np.nan_to_num(moments.now[..., 1])
    seen = np.isfinite(y).sum(axis=1)
    last = np.take_along_axis(y, np.maximum(seen - 1, 0)[:, None], axis=1)[:, 0]
    side = lanes_of(moments.lanes, np.where(np.isfinite(last), last, now)) - lanes_of(moments.lanes, now)
    counts = moments.predicted & (seen >= SURE) & (np.abs(side) <= 1)
    return _Known(counts, side * counts)


def _fit_drivers(
    moments: Moments, known: _Known, progress: Progress, begin: Parameters | None = None, iterations: int = MOST
) -> tuple[Parameters, Drivers]:
    """Return the logarithms of `FIRST` and of the factors of `CHANGING` that bring drivers closest to the recorded.

    Also return the drivers, with the intentions that make their lane changes most likely.
    """
    first, number = np.concatenate([np.log(list(FIRST.values())), np.zeros(len(CHANGING))]), known.counts.sum()
    given, evaluations = _in_single_precision(moments), count(1)

    def value(logarithms: Parameters) -> tuple[Scalar, Parameters]:
        progress(f"fitting {known.counts.any(axis=1).sum()} moments seconds ahead, evaluation {next(evaluations)}")
        off, slope = _mean_off(logarithms, given, known)
        far = (logarithms - first) / DEVIATIONS
        return float(off) + far @ far / (2 * number), np.asarray(slope, dtype=float) + far / DEVIATIONS / number

    found = minimum(value, first if begin is None else begin, maxiter=iterations, ftol=1e-6)
    return found, structs.replace(_drivers(found), intention=_intention(moments, known))


def _in_single_precision(moments: Moments) -> Moments:
    return jax.tree.map(lambda part: jnp.asarray(part, jnp.float32 if part.dtype.kind == "f" else None), moments)


def _drivers(logarithms: Parameters) -> Drivers:
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
def _mean_off(logarithms: Parameters, moments: Moments, known: _Known) -> Scalar:
    """Return how far off drivers are who drive on together to where they go, mean over drivers and horizons."""
    off, counts = _off(logarithms, moments, known)
    return off.sum() / counts.sum()


@jax.jit
@jax.jacfwd
def _slopes(logarithms: Parameters, moments: Moments, known: _Known) -> Cars:
    """Return the slopes of every driver's part of `_mean_off` [n, cars, parameters]."""
    off, counts = _off(logarithms, moments, known)
    return off / counts.sum()


def _off(logarithms: Parameters, moments: Moments, known: _Known) -> tuple[Cars, Cars]:
    """Return the sum of ``sqrt(1 + (e / s)^2) - 1`` of every driver, along and across, and at how many horizons."""
    drivers = _drivers(logarithms)

    def one(pair: tuple[Moments, _Known]) -> tuple[Cars, Cars]:
        moment, known = pair
        path = drive_on(drivers, moment, shown_traits(drivers, moment, moment.past), known.side)[AT, :, :2]
        recorded = moment.future[AT, :, :2]
        counts = jnp.isfinite(recorded).all(axis=-1) & known.counts
        error = jnp.where(counts[..., None], path - jnp.nan_to_num(recorded), 0.0) / SCALES[:, None]
        return jnp.sum(jnp.sqrt(1 + error**2) - 1, axis=(0, 2)), counts.sum(axis=0)

    return jax.lax.map(one, (moments, known), batch_size=AT_ONCE)


def _predict_unknown(
    moments: Moments, known: _Known, begin: Parameters, chosen: Flags, progress: Progress
) -> Modes | None:
    """Predict every group of recordings by what is learned from the others; None if there are too few groups.

    The spread around predictions of drivers who were learned from would be too narrow for others.
    """
    names = np.unique(moments.group[chosen])
    if len(names) < FOLDS:
        return None
    fold = np.searchsorted(names, moments.group) % FOLDS

    def without(number: int) -> Modes:
        return predict(moments, _fit_drivers(moments, known.among(fold != number), progress, begin, REFIT)[1])

    return moments.by_fold(fold, list(map(without, range(FOLDS))))


def _deviations(found: Parameters, moments: Moments, known: _Known) -> list[float]:
    """Return the standard deviations of what was found, with drivers as the independent units.

    That of least errors, with the slopes of each driver's errors at all its moments, and the Hessian with the prior, of
    finite differences.
    """
    given = _in_single_precision(moments)
    hessian = slope_differences(lambda logarithms: _mean_off(logarithms, given, known)[1], found, DIFFERENCE)
    prior = np.diag(1 / DEVIATIONS**2) / known.counts.sum()
    inverse = np.linalg.pinv((hessian + hessian.T) / 2 + prior, hermitian=True)
    slopes = np.asarray(_slopes(found, given, known), dtype=float)[known.counts]
    return np.sqrt(np.diag(grouped_covariance(inverse, slopes, moments.track[known.counts]))).tolist()


def _intention(moments: Moments, known: _Known) -> Intention:
    """Return the most likely intention, of logistic regression with a weak prior."""
    mode = -known.side[known.counts] % len(SIDES)
    drawn, exist = (np.asarray(part)[known.counts] for part in _advantages(_in_single_precision(moments)))
    drawn = drawn.astype(float)

    def surprise(numbers: Parameters) -> float:
        odds = np.where(exist, numbers[:2] + drawn @ numbers[2:], -np.inf)
        odds = np.concatenate([np.zeros((len(odds), 1)), odds], axis=1)
        likely = odds[np.arange(len(mode)), mode] - special.logsumexp(odds, axis=1)
        return float(numbers @ numbers / (2 * ODDS**2) - likely.sum())

    found = optimize.minimize(surprise, np.array([-3.0, -3.0, *np.zeros(6)])).x
    return Intention(found[:2], found[2:])


_advantages = jax.jit(jax.vmap(lane_advantages))
