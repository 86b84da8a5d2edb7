"""Learn drivers from where they are seconds later: weights, traits, lane changes and the spread around predictions.

Segments of half a second, see `ms_highway.irl.maximum_entropy`, are mostly noise: the accelerations of recorded cars
waver by more than what drivers want differs. So the weights that matter in a lane are those under which all cars of a
snapshot, driving on together, come closest to where they were recorded 1, 2, 3 and 5 s later.
"""

from itertools import count

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import structs
from scipy import optimize, special

from ms_highway.game.learned_drivers import CHANGING, LEARNED, Drivers, Intention, LearnedDrivers, TraitPrior
from ms_highway.irl.mixture import SIDES, fit_spread
from ms_highway.irl.prediction import fit_peers, lane_advantages, predict_drivers, roll_out
from ms_highway.irl.recording import CarFlags, CarNumbers, Cars
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


def learn_drivers(snapshots: Snapshots, intervals: bool = True, progress: Progress = silent) -> LearnedDrivers:
    """Learn drivers, with the weights `LEARNED` and that of the comfort of acceleration, 0.1, and fit all peers.

    Args:
        snapshots: to learn from; one compilation serves all of a number, see `Snapshots.only`.
        intervals: whether to compute the drivers' ``deviations``.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for as long as 2 s.
    """
    if not np.any(_labels(snapshots)[0]):
        raise ValueError(f"no driver was seen for {SURE / 10:g} s on end; nothing can be learned seconds ahead")
    found, drivers = _fit_drivers(snapshots, progress)
    groups = np.unique(snapshots.group[snapshots.which])
    parts = [(snapshots, drivers)]
    if len(groups) >= FOLDS:  # the spread around predictions of drivers who were learned from is too narrow for others
        fold = np.searchsorted(groups, snapshots.group) % FOLDS
        rest = [_fit_drivers(snapshots.only(fold != number), progress, found, REFIT)[1] for number in range(FOLDS)]
        parts = [(snapshots.of(fold == number), drivers) for number, drivers in enumerate(rest)]
    predicted = [(predict_drivers(some, fitted), some.recorded) for some, fitted in parts]
    spread = fit_spread(*jax.tree.map(lambda *rows: np.concatenate(rows), *predicted))
    deviations = dict(zip(NAMES, _deviations(found, snapshots), strict=True)) if intervals else {}
    progress("fitting the predictors to compare with")
    return LearnedDrivers(
        **structs.asdict(plain(drivers)), spread=spread, deviations=deviations, peers=fit_peers(snapshots)
    )


def _fit_drivers(
    snapshots: Snapshots, progress: Progress, begin: Parameters = MEDIANS, iterations: int = MOST
) -> tuple[Parameters, Drivers]:
    """Return the logarithms of `FIRST` and of the factors of `CHANGING` that bring drivers closest to the recorded.

    Also return the drivers, with the intentions that make their lane changes most likely.
    """
    learned_from, _ = _labels(snapshots)
    number, used = learned_from.sum(), learned_from.any(axis=1).sum()
    data, evaluations = jax.device_put(snapshots), count(1)

    def loss(logarithms: Parameters) -> tuple[float, Parameters]:
        progress(f"fitting {used} snapshots seconds ahead, evaluation {next(evaluations)}")
        error, slope = _mean_error(logarithms, data)
        far = (logarithms - MEDIANS) / DEVIATIONS
        prior = far @ far / (2 * number), far / DEVIATIONS / number
        return float(error) + prior[0], np.asarray(slope, dtype=float) + prior[1]

    found = minimum(loss, begin, maxiter=iterations, ftol=1e-6)
    return found, structs.replace(_drivers_of(found), intention=_fit_intention(data))


def _drivers_of(logarithms: Parameters) -> Drivers:
    """Return the drivers of what `_fit_drivers` finds; they keep their lanes."""
    xp = logarithms.__array_namespace__()
    numbers, factors = xp.exp(logarithms[: len(FIRST)]), xp.exp(logarithms[len(FIRST) :])
    headway, *deviations, noise = numbers[len(LEARNED) :]
    prior = TraitPrior(xp.stack([xp.ones_like(headway), headway, xp.ones_like(headway)]), xp.stack(deviations), noise)
    weights = {**dict(zip(LEARNED, numbers, strict=False)), "comfort_acceleration": COMFORT}
    keeping = Intention(np.full(2, -20.0), np.zeros(6))  # type: ignore[arg-type]
    return Drivers(weights, prior, dict(zip(CHANGING, factors, strict=True)), keeping)


def _label(snapshot: Snapshots) -> tuple[CarFlags, CarNumbers]:
    """Return which cars of a snapshot are learned from, and how many lanes to the right these change lanes.

    They are predicted, seen for 2 s, and at last, within 5 s, in their lane or one beside it.
    """
    y = jnp.concatenate([snapshot.past[-1:], snapshot.future])[..., 1]
    seen = jnp.isfinite(y[1:]).sum(axis=0)
    last = jnp.take_along_axis(y, seen[None], axis=0)[0]
    side = lane_numbers(snapshot.lanes, last) - lane_numbers(snapshot.lanes, y[0])
    learned_from = snapshot.predicted & (seen >= SURE) & (jnp.abs(side) <= 1)
    return learned_from, side * learned_from


_labels = jax.jit(jax.vmap(_label))


@jax.jit
@jax.value_and_grad
def _mean_error(logarithms: Parameters, snapshots: Snapshots) -> Scalar:
    """Return the mean error, over drivers and horizons, of drivers who drive on together to where they go."""
    return _shares(logarithms, snapshots).sum()


def _shares(logarithms: Parameters, snapshots: Snapshots) -> Cars:
    """Return every driver's part [n, cars] of the mean of ``sqrt(1 + (e / s)^2) - 1``, along and across."""
    drivers = _drivers_of(logarithms)

    def one(snapshot: Snapshots) -> tuple[Cars, Cars]:
        learned_from, side = _label(snapshot)
        traits = shown_traits(drivers, snapshot, snapshot.past)
        path = roll_out(drivers, snapshot, traits, side)[AT, :, :2]
        recorded = snapshot.future[AT, :, :2]
        counts = jnp.isfinite(recorded).all(axis=-1) & learned_from
        error = jnp.where(counts[..., None], path - jnp.nan_to_num(recorded), 0.0) / SCALES[:, None]
        return jnp.sum(jnp.sqrt(1 + error**2) - 1, axis=(0, 2)), counts.sum(axis=0)

    errors, counts = jax.lax.map(one, snapshots, batch_size=AT_ONCE)
    return errors / counts.sum()


_scores = jax.jit(jax.jacfwd(_shares))  # slopes of every driver's part [n, cars, parameters]


def _deviations(found: Parameters, snapshots: Snapshots) -> list[float]:
    """Return the standard deviations of what was found, with drivers as the independent units.

    They are those of least errors, with the slopes of each driver's errors in all its snapshots, and the Hessian with
    the prior, of finite differences.
    """
    data, learned_from = jax.device_put(snapshots), np.asarray(_labels(snapshots)[0])
    hessian = slope_differences(lambda logarithms: _mean_error(logarithms, data)[1], found, DIFFERENCE)
    prior = np.diag(1 / DEVIATIONS**2) / learned_from.sum()
    inverse = np.linalg.pinv((hessian + hessian.T) / 2 + prior, hermitian=True)
    scores = np.asarray(_scores(found, data), dtype=float)[learned_from]
    return np.sqrt(np.diag(grouped_covariance(inverse, scores, snapshots.track[learned_from]))).tolist()


def _fit_intention(snapshots: Snapshots) -> Intention:
    """Return the most likely intention, of logistic regression with a weak prior."""
    learned_from, side = map(np.asarray, _labels(snapshots))
    mode = -side[learned_from] % len(SIDES)
    advantages, exist = (np.asarray(part)[learned_from] for part in _advantages(snapshots))
    advantages = advantages.astype(float)

    def loss(numbers: Parameters) -> float:
        odds = np.where(exist, numbers[:2] + advantages @ numbers[2:], -np.inf)
        odds = np.concatenate([np.zeros((len(odds), 1)), odds], axis=1)
        likely = odds[np.arange(len(mode)), mode] - special.logsumexp(odds, axis=1)
        return float(numbers @ numbers / (2 * ODDS**2) - likely.sum())

    found = optimize.minimize(loss, np.array([-3.0, -3.0, *np.zeros(6)])).x
    return Intention(found[:2], found[2:])


_advantages = jax.jit(jax.vmap(lane_advantages))
