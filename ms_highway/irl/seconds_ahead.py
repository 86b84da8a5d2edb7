"""Learn drivers from where they are seconds later: weights, traits, lane changes and
the spread around predictions.

Segments of half a second (`ms_highway.irl.maximum_entropy`) are mostly noise: recorded
accelerations waver by more than drivers' preferences differ. The weights that matter in
a lane are therefore those under which all cars of a snapshot, driving on together, come
closest to where they were recorded 1, 2, 3 and 5 s later.
"""

from itertools import count

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import structs
from scipy import optimize, special

from ms_highway.data.learned_drivers import (
    CHANGING,
    LEARNED,
    Drivers,
    Intention,
    LearnedDrivers,
    TraitPrior,
)
from ms_highway.irl.driving import lane_numbers, roll_out, shown_traits
from ms_highway.irl.mixture import SIDES, fit_spread
from ms_highway.irl.prediction import (
    fit_peers,
    lane_advantages,
    predict_drivers,
    robust_errors,
)
from ms_highway.irl.recording import CarFlags, CarNumbers, Cars
from ms_highway.irl.snapshots import Snapshots
from ms_highway.numerics.estimation import (
    Parameters,
    grouped_covariance,
    minimum,
    slope_differences,
)
from ms_highway.runtime.arrays import Scalar, plain
from ms_highway.runtime.process import Progress, silent

SURE = 20  # steps for which a driver must be seen, to know whether it changes lanes
COMFORT = (
    0.1  # weight of the comfort of acceleration, which sets the scale of all others
)
CHANGES = " while changing lanes"  # end of the names of factors
MEDIANS = {
    **dict(zip(LEARNED, (7e-4, 4e-3, 0.1, 0.1, 0.2, 0.05), strict=True)),
    **{
        "typical headway": 1.2,
        "desired speeds": 0.15,
        "headways": 0.5,
        "patiences": 0.4,
        "noise": 0.7,
    },
    **{name + CHANGES: 1.0 for name in CHANGING},
}  # of the prior: of weights, the median headway, deviations of traits, noise, and factors while changing lanes
FIRST = np.log(
    [*MEDIANS.values()]
)  # means of the prior's logarithms, from which the fit starts
WIDE, NARROW = (
    2.0,
    0.7,
)  # standard deviations of the prior's logarithms, of weights and their factors and of the rest
DEVIATIONS = np.array(
    [WIDE if name.removesuffix(CHANGES) in LEARNED else NARROW for name in MEDIANS]
)
ODDS = 3.0  # standard deviation of the prior of an intention's numbers
ITERATIONS, REFIT = (
    60,
    10,
)  # of the fit to all drivers, and of fits to some of them that start from it
FOLDS = 3  # of recordings, to learn the spread of drivers who were not learned from
DIFFERENCE = 0.02  # of logarithms, for second derivatives in single precision
AT_ONCE = 35  # snapshots, so that gradients fit in memory


def learn_drivers(
    snapshots: Snapshots, intervals: bool = True, progress: Progress = silent
) -> LearnedDrivers:
    """Learn drivers with the weights `LEARNED` and the given weight 0.1 of the comfort
    of acceleration; fit all peers.

    Args:
        snapshots: to learn from; their number sets the shapes for which functions are
            compiled, see `Snapshots.only`.
        intervals: whether to compute the drivers' ``deviations``.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for 2 s.
    """
    if not np.any(_labels(snapshots)[0]):
        raise ValueError(
            f"no driver was seen for {SURE / 10:g} s; nothing can be learned seconds"
            " ahead"
        )
    found, drivers = _fit_drivers(snapshots, progress)
    groups = np.unique(snapshots.group[snapshots.which])
    parts = [(snapshots, drivers)]
    if (
        len(groups) >= FOLDS
    ):  # or else the spread is that of drivers who were learned from: too narrow for others
        fold = np.searchsorted(groups, snapshots.group) % FOLDS
        rest = [
            _fit_drivers(snapshots.only(fold != number), progress, found, REFIT)[1]
            for number in range(FOLDS)
        ]
        parts = [
            (snapshots.of(fold == number), drivers)
            for number, drivers in enumerate(rest)
        ]
    predicted = [
        (predict_drivers(some, fitted), some.recorded) for some, fitted in parts
    ]
    spread = fit_spread(*jax.tree.map(lambda *rows: np.concatenate(rows), *predicted))
    deviations = (
        dict(zip(MEDIANS, _deviations(found, snapshots), strict=True))
        if intervals
        else {}
    )
    progress("fitting the predictors to compare with")
    return LearnedDrivers(
        **structs.asdict(plain(drivers)),
        spread=spread,
        deviations=deviations,
        peers=fit_peers(snapshots),
    )


def _fit_drivers(
    snapshots: Snapshots,
    progress: Progress,
    first: Parameters = FIRST,
    iterations: int = ITERATIONS,
) -> tuple[Parameters, Drivers]:
    """Return the logarithms, as in `FIRST`, under which drivers come closest to the
    recording; and these drivers.

    The drivers have the intention that makes their lane changes most likely.
    """
    learned_from, _ = _labels(snapshots)
    number = learned_from.sum()
    used = learned_from.any(axis=1).sum()
    data = jax.device_put(snapshots)
    evaluations = count(1)

    def loss(logarithms: Parameters) -> tuple[float, Parameters]:
        progress(
            f"fitting {used} snapshots seconds ahead, evaluation {next(evaluations)}"
        )
        error, slope = _mean_error(logarithms, data)
        far = (logarithms - FIRST) / DEVIATIONS
        prior = far @ far / (2 * number)
        prior_slope = far / DEVIATIONS / number
        return float(error) + prior, np.asarray(slope, dtype=float) + prior_slope

    found = minimum(loss, first, maxiter=iterations, ftol=1e-6)
    return found, structs.replace(_drivers_of(found), intention=_fit_intention(data))


def _drivers_of(logarithms: Parameters) -> Drivers:
    """Return the drivers with these logarithms, as in `FIRST`; they keep their lanes."""
    xp = logarithms.__array_namespace__()
    parts = xp.split(xp.exp(logarithms), [len(LEARNED), len(MEDIANS) - len(CHANGING)])
    weights, (headway, *deviations, noise), factors = parts
    prior = TraitPrior(
        xp.stack([xp.ones_like(headway), headway, xp.ones_like(headway)]),
        xp.stack(deviations),
        noise,
    )
    named = {
        **dict(zip(LEARNED, weights, strict=True)),
        "comfort_acceleration": COMFORT,
    }
    keeping = Intention(np.full(2, -20.0), np.zeros(6))  # type: ignore[arg-type]
    return Drivers(named, prior, dict(zip(CHANGING, factors, strict=True)), keeping)


def _label(snapshot: Snapshots) -> tuple[CarFlags, CarNumbers]:
    """Return which cars of a snapshot are learned from, and by how many lanes to the
    right each of these changes.

    A driver to predict is learned from if it is seen for 2 s, and if its last position
    within 5 s is in its own lane or in a lane beside it.
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
    """Return the mean of `robust_errors` in a joint simulation, in which each driver
    aims at its recorded lane.
    """
    return _shares(logarithms, snapshots).sum()


def _shares(logarithms: Parameters, snapshots: Snapshots) -> Cars:
    """Return every driver's share [n, cars] of the mean error."""
    drivers = _drivers_of(logarithms)

    def one(snapshot: Snapshots) -> tuple[Cars, Cars]:
        learned_from, side = _label(snapshot)
        traits = shown_traits(drivers, snapshot)
        path = roll_out(drivers, snapshot, traits, side)[..., :2]
        errors, known = robust_errors(path, snapshot.future, learned_from)
        return jnp.sum(errors, axis=(0, 2)), known.sum(axis=0)

    errors, known = jax.lax.map(one, snapshots, batch_size=AT_ONCE)
    return errors / known.sum()


_scores = jax.jit(
    jax.jacfwd(_shares)
)  # slopes of every driver's share [n, cars, parameters]


def _deviations(found: Parameters, snapshots: Snapshots) -> list[float]:
    """Return the standard deviations of the logarithms that were found, with drivers as
    the independent units.

    The scores are the slopes of each driver's errors in all its snapshots; the Hessian,
    with the prior, is by finite differences.
    """
    data = jax.device_put(snapshots)
    learned_from = np.asarray(_labels(snapshots)[0])
    hessian = slope_differences(
        lambda logarithms: _mean_error(logarithms, data)[1], found, DIFFERENCE
    )
    prior = np.diag(1 / DEVIATIONS**2) / learned_from.sum()
    inverse = np.linalg.pinv((hessian + hessian.T) / 2 + prior, hermitian=True)
    scores = np.asarray(_scores(found, data), dtype=float)[learned_from]
    return np.sqrt(
        np.diag(grouped_covariance(inverse, scores, snapshots.track[learned_from]))
    ).tolist()


def _fit_intention(snapshots: Snapshots) -> Intention:
    """Return the most likely intention by logistic regression with a weak prior."""
    learned_from, side = map(np.asarray, _labels(snapshots))
    mode = -side[learned_from] % len(SIDES)
    advantages, exist = (
        np.asarray(part, dtype=float)[learned_from] for part in _advantages(snapshots)
    )

    def loss(numbers: Parameters) -> float:
        odds = np.where(exist, numbers[:2] + advantages @ numbers[2:], -np.inf)
        odds = np.pad(odds, ((0, 0), (1, 0)))  # of keeping the lane: 0
        log_likelihoods = odds[np.arange(len(mode)), mode] - special.logsumexp(
            odds, axis=1
        )
        return float(numbers @ numbers / (2 * ODDS**2) - log_likelihoods.sum())

    found = optimize.minimize(loss, np.array([-3.0, -3.0, *np.zeros(6)])).x
    return Intention(found[:2], found[2:])


_advantages = jax.jit(jax.vmap(lane_advantages))
