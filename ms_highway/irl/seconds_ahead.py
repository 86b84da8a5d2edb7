"""Learn drivers from where they are seconds later: weights, traits, lane changes and the spread around predictions.

Windows of half a second, see `ms_highway.irl.maximum_entropy`, are mostly noise: the accelerations of recorded cars
waver by more than what drivers want differs. So the weights that matter in a lane are those under which all cars of a
moment, driving on together, come closest to where they were recorded 1, 2, 3 and 5 s later.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int
from scipy import optimize, special

from ms_highway.game.learned_drivers import CHANGING, LEARNED, Intention, LearnedDrivers, TraitPrior
from ms_highway.irl.driving import Changing, Drivers, advantages, drive_together, predict
from ms_highway.irl.errors import AT, SCALES
from ms_highway.irl.moments import Moments, lanes_of
from ms_highway.irl.outlook import Modes, fit_spread
from ms_highway.planning.held_control import DrivingWeights
from ms_highway.runtime.progress import Progress, silent

__all__ = ["drivers_of", "learn_drivers"]

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
        lane: number of the lane that each car is in when it is seen last, within 5 s.
        keeps, changes: which drivers are still in their lane then, or in one beside it; those seen for 2 s.
    """

    lane: Int[Any, "n cars"]
    keeps: Bool[Any, "n cars"]
    changes: Bool[Any, "n cars"]

    @property
    def counts(self) -> Bool[Any, "n cars"]:
        """Which drivers are learned from."""
        return self.keeps | self.changes

    def among(self, chosen: Bool[np.ndarray, "n"]) -> Self:
        """Return what is known of the drivers of some moments only."""
        return self._replace(keeps=self.keeps & chosen[:, None], changes=self.changes & chosen[:, None])


def learn_drivers(
    moments: Moments,
    chosen: Bool[np.ndarray, "n"] | None = None,
    *,
    intervals: bool = True,
    progress: Progress = silent,
) -> LearnedDrivers:
    """Learn drivers, with the weights `LEARNED` and that of the comfort of acceleration, 0.1.

    Args:
        moments: to learn from.
        chosen: which of them; all by default. One compilation serves any choice.
        intervals: whether to compute the drivers' ``deviations``.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for as long as 2 s.
    """
    chosen = np.ones(len(moments), dtype=bool) if chosen is None else chosen
    known = _afterwards(moments).among(chosen)
    if not known.keeps.any():
        raise ValueError(f"no driver was seen for {SURE / 10:g} s on end; nothing can be learned seconds ahead")
    progress("fitting drivers seconds ahead")
    found, drivers = _fit(moments, known)
    progress("fitting the spread around drivers who were not learned from")
    modes = _predict_unknown(moments, known, found, chosen) or predict(moments, drivers)
    recorded = np.where(_of_drivers(moments, chosen)[:, None, None], moments.recorded, np.nan)
    values = dict(zip(FIRST, np.exp(found[: len(FIRST)]).tolist(), strict=True))
    learned = LearnedDrivers(
        weights={name: values[name] for name in LEARNED} | {"comfort_acceleration": COMFORT},
        prior=jax.tree.map(np.asarray, drivers.prior),
        changing=dict(zip(CHANGING, np.exp(found[len(FIRST) :]).tolist(), strict=True)),
        intention=drivers.intention,
        spread=fit_spread(modes, recorded),
        deviations=dict(zip(NAMES, _deviations(found, moments, known), strict=True)) if intervals else {},
    )
    return LearnedDrivers.read(learned.written())


def drivers_of(learned: LearnedDrivers) -> Drivers:
    """Return what predictions need of learned drivers."""
    return Drivers(DrivingWeights.of(learned.weights), learned.prior, _changing(learned.changing), learned.intention)


def _changing(factors: Mapping[str, Any]) -> Changing:
    of_weights = DrivingWeights(**{name: factors[name] for name in LEARNED}, comfort_acceleration=1.0)
    return Changing(of_weights, factors["desired speed"], factors["typical headway"])


def _afterwards(moments: Moments) -> _Known:
    y = np.asarray(moments.future)[..., 1]
    seen = np.isfinite(y).sum(axis=1)
    last = np.take_along_axis(y, np.maximum(seen - 1, 0)[:, None], axis=1)[:, 0]
    now, lanes = np.nan_to_num(np.asarray(moments.now)[..., 1]), np.asarray(moments.lanes)
    before, after = lanes_of(lanes, now), lanes_of(lanes, np.where(np.isfinite(last), last, now))
    sure = moments.predicted & (seen >= SURE)
    return _Known(after, sure & (after == before), sure & (np.abs(after - before) == 1))


def _of_drivers(moments: Moments, values: np.ndarray) -> np.ndarray:
    """Return values [n] of moments for every predicted driver."""
    return np.repeat(values[:, None], moments.predicted.shape[1], axis=1)[moments.predicted]


def _fit(
    moments: Moments, known: _Known, begin: Float[np.ndarray, "parameters"] | None = None, iterations: int = MOST
) -> tuple[Float[np.ndarray, "parameters"], Drivers]:
    """Return the logarithms of `FIRST` and of the factors of `CHANGING` that bring drivers closest to the recorded.

    Also return the drivers, with the intentions that make their lane changes most likely.
    """
    first, number = np.concatenate([np.log(list(FIRST.values())), np.zeros(len(CHANGING))]), known.counts.sum()
    given = _single(moments)

    def value(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        off, slope = _mean_off(jnp.asarray(logarithms), given, known)
        far = (logarithms - first) / DEVIATIONS
        return float(off) + far @ far / (2 * number), np.asarray(slope, dtype=float) + far / DEVIATIONS / number

    options = {"maxiter": iterations, "ftol": 1e-6}
    found = optimize.minimize(value, first if begin is None else begin, jac=True, method="L-BFGS-B", options=options).x
    return found, _drivers(found)._replace(intention=_intention(moments, known))


def _single(moments: Moments) -> Moments:
    return jax.tree.map(lambda part: jnp.asarray(part, jnp.float32 if part.dtype.kind == "f" else None), moments)


def _drivers(logarithms: Float[Any, "parameters"]) -> Drivers:
    """Return the drivers of what `_fit` finds; they keep their lanes."""
    xp = logarithms.__array_namespace__()
    numbers, factors = xp.exp(logarithms[: len(FIRST)]), xp.exp(logarithms[len(FIRST) :])
    headway, *deviations, noise = numbers[len(LEARNED) :]
    prior = TraitPrior(xp.stack([xp.ones_like(headway), headway, xp.ones_like(headway)]), xp.stack(deviations), noise)
    learned = dict(zip(LEARNED, numbers, strict=False))
    weights = DrivingWeights(**learned, comfort_acceleration=COMFORT)
    changing = _changing(dict(zip(CHANGING, factors, strict=True)))
    return Drivers(weights, prior, changing, Intention(np.full(2, -20.0), np.zeros(6)))


@jax.jit
@jax.value_and_grad
def _mean_off(logarithms: Float[jax.Array, "parameters"], moments: Moments, known: _Known) -> Float[jax.Array, ""]:
    """Return how far off drivers are who drive on together to where they go, mean over drivers and horizons."""
    off, counts = _off(logarithms, moments, known)
    return off.sum() / counts.sum()


@jax.jit
def _slopes(
    logarithms: Float[jax.Array, "parameters"], moments: Moments, known: _Known
) -> Float[jax.Array, "n cars parameters"]:
    """Return the slopes of every driver's part of `_mean_off`."""
    return jax.jacfwd(lambda logarithms: _shares(*_off(logarithms, moments, known)))(logarithms)


def _shares(off: Float[jax.Array, "n cars"], counts: Float[jax.Array, "n cars"]) -> Float[jax.Array, "n cars"]:
    return off / counts.sum()


def _off(
    logarithms: Float[jax.Array, "parameters"], moments: Moments, known: _Known
) -> tuple[Float[jax.Array, "n cars"], Float[jax.Array, "n cars"]]:
    """Return the sum of ``sqrt(1 + (e / s)^2) - 1`` of every driver, along and across, and at how many horizons."""
    drivers = _drivers(logarithms)

    def one(moment: Moments, known: _Known) -> tuple[jax.Array, jax.Array]:
        path = drive_together(drivers, moment, known.lane, known.changes)[AT, :, :2]
        recorded = moment.future[AT, :, :2]
        counts = jnp.isfinite(recorded).all(axis=-1) & known.counts
        error = jnp.where(counts[..., None], path - jnp.nan_to_num(recorded), 0.0) / SCALES[:, None]
        return jnp.sum(jnp.sqrt(1 + error**2) - 1, axis=(0, 2)), counts.sum(axis=0)

    off, counts = jax.lax.map(lambda pair: one(*pair), (moments, known), batch_size=AT_ONCE)
    return off, counts


def _predict_unknown(
    moments: Moments, known: _Known, begin: Float[np.ndarray, "parameters"], chosen: Bool[np.ndarray, "n"]
) -> Modes | None:
    """Predict every group of recordings by what is learned from the others; None if there are too few groups.

    The spread around predictions of drivers who were learned from would be too narrow for others.
    """
    names = np.unique(moments.group[chosen])
    if len(names) < FOLDS:
        return None
    fold = _of_drivers(moments, np.searchsorted(names, moments.group) % FOLDS)
    parts = []
    for number in range(FOLDS):
        learned_from = known.among(np.searchsorted(names, moments.group) % FOLDS != number)
        parts.append(predict(moments, _fit(moments, learned_from, begin, REFIT)[1]))
    return Modes(*(np.stack(part)[fold, np.arange(len(fold))] for part in zip(*parts, strict=True)))


def _deviations(found: Float[np.ndarray, "parameters"], moments: Moments, known: _Known) -> list[float]:
    """Return the standard deviations of what was found, with drivers as the independent units.

    That of least errors, the roots of the diagonal of ``B sum_i s_i s_i^T B`` (Huber 1967), with the slope s_i of the
    error of driver i at all its moments, and the inverse B of the Hessian with the prior, of finite differences.
    """
    given = _single(moments)
    steps = DIFFERENCE * np.eye(len(found))
    rows = [np.subtract(*(_mean_off(jnp.asarray(found + s), given, known)[1] for s in (step, -step))) for step in steps]
    hessian = np.array(rows, dtype=float) / (2 * DIFFERENCE)
    prior = np.diag(1 / DEVIATIONS**2) / known.counts.sum()
    inverse = np.linalg.pinv((hessian + hessian.T) / 2 + prior, hermitian=True)
    slopes = np.asarray(_slopes(jnp.asarray(found), given, known), dtype=float)[known.counts]
    tracks = moments.track[known.counts]
    scores = np.stack([slopes[tracks == track].sum(axis=0) for track in np.unique(tracks)])
    return np.sqrt(np.diag(inverse @ (scores.T @ scores) @ inverse)).tolist()


def _intention(moments: Moments, known: _Known) -> Intention:
    """Return the most likely intention, of logistic regression with a weak prior."""
    drawn, exist = map(np.asarray, _advantages(_single(moments)))
    now = lanes_of(np.asarray(moments.lanes), np.nan_to_num(np.asarray(moments.now)[..., 1]))
    side = np.where(known.lane < now, 1, 2) * known.changes
    drawn, exist, side = drawn[known.counts].astype(float), exist[known.counts], side[known.counts]

    def surprise(numbers: np.ndarray) -> float:
        odds = np.where(exist, numbers[:2] + drawn @ numbers[2:], -np.inf)
        odds = np.concatenate([np.zeros((len(odds), 1)), odds], axis=1)
        likely = odds[np.arange(len(side)), side] - special.logsumexp(odds, axis=1)
        return float(numbers @ numbers / (2 * ODDS**2) - likely.sum())

    found = optimize.minimize(surprise, np.array([-3.0, -3.0, *np.zeros(6)])).x
    return Intention(found[:2], found[2:])


_advantages = jax.jit(jax.vmap(advantages))
