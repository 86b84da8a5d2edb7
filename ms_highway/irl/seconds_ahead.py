"""Learn drivers from where they are seconds later: weights, traits, lane changes and the spread around predictions.

Windows of half a second, see `ms_highway.irl.maximum_entropy`, are mostly noise: the accelerations of recorded cars
waver by more than what drivers want differs. So the weights that matter in a lane are those under which all cars of a
moment, driving on together, come closest to where they were recorded 1, 2, 3 and 5 s later.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int
from scipy import optimize, special

from ms_highway.game.learned_drivers import Intention, LearnedDrivers, TraitPrior
from ms_highway.irl.driving import Changing, Drivers, advantages, drive_together, predict
from ms_highway.irl.moments import Moments, lanes_of
from ms_highway.irl.outlook import fit_spread
from ms_highway.planning.held_control import DrivingWeights
from ms_highway.runtime.progress import Progress, silent

__all__ = ["LEARNED", "drivers_of", "learn_drivers"]

HORIZONS = np.array([10, 20, 30, 50])  # steps
SCALES = np.array([[0.4, 0.1], [1.0, 0.3], [1.8, 0.5], [3.5, 0.8]])  # m, along and across, of errors at the horizons
SURE = 20  # steps for which a driver must be seen, to know whether it changes lanes

LEARNED = ("speed", "headway", "closing_speed", "lane_alignment", "direction", "comfort_steering")
"""Weights that are learned seconds ahead, relative to that of the comfort of acceleration."""

COMFORT = 0.1
FIRST = {
    **dict(zip(LEARNED, (7e-4, 4e-3, 0.1, 0.1, 0.2, 0.05), strict=True)),
    **{"typical headway": 1.2, "desired speeds": 0.15, "headways": 0.5, "patiences": 0.4, "noise": 0.7},
}  # that the fit starts from, and the medians of its prior: weights, median headway, deviations of traits, and noise
CHANGING = (*LEARNED, "desired speed", "typical headway")  # what has a factor while changing lanes
WIDE, NARROW = 2.0, 0.7  # standard deviations of the prior, of logarithms of weights and of all else
AT_ONCE = 35  # moments, so that gradients fit in memory
ODDS = 3.0  # standard deviation of the prior of an intention's numbers


class _Known(NamedTuple):
    """What is known of the drivers of moments after the fact.

    Attributes:
        lane: number of the lane that each car is in when it is seen last, within 5 s.
        keeps, changes: which drivers are still in their lane then, or in one beside it; those seen for 2 s.
    """

    lane: Int[Any, "n cars"]
    keeps: Bool[Any, "n cars"]
    changes: Bool[Any, "n cars"]


def learn_drivers(moments: Moments, *, progress: Progress = silent) -> tuple[dict[str, float], LearnedDrivers]:
    """Learn the weights `LEARNED`, with that of the comfort of acceleration 0.1, and the drivers beside them.

    Args:
        moments: to learn from.
        progress: called with a message when a part begins.

    Raises:
        ValueError: if no driver was seen for as long as 2 s.
    """
    known = _afterwards(moments)
    if not known.keeps.any():
        raise ValueError(f"no driver was seen for {SURE / 10:g} s on end; nothing can be learned seconds ahead")
    progress("fitting drivers seconds ahead")
    found = _closest(moments, known)
    values = dict(zip(FIRST, np.exp(found[: len(FIRST)]).tolist(), strict=True))
    weights = {name: values[name] for name in LEARNED} | {"comfort_acceleration": COMFORT}
    drivers = _drivers(found)._replace(intention=_intention(moments, known))
    progress("fitting the spread")
    positions = moments.drivers(np.moveaxis(np.asarray(moments.future), 1, 2))[..., :2]
    return weights, LearnedDrivers(
        prior=jax.tree.map(np.asarray, drivers.prior),
        changing=dict(zip(CHANGING, np.exp(found[len(FIRST) :]).tolist(), strict=True)),
        intention=drivers.intention,
        spread=fit_spread(predict(moments, drivers), positions),
    )


def drivers_of(weights: Mapping[str, float], learned: LearnedDrivers) -> Drivers:
    """Return what predictions need of a learned reward's weights and of its drivers."""
    return Drivers(DrivingWeights.of(weights), learned.prior, _changing(learned.changing), learned.intention)


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


def _closest(moments: Moments, known: _Known) -> Float[np.ndarray, "parameters"]:
    """Return the logarithms of `FIRST` and of the factors of `CHANGING` that bring drivers closest to the recorded."""
    first = np.concatenate([np.log(list(FIRST.values())), np.zeros(len(CHANGING))])
    wide = [WIDE if name in LEARNED else NARROW for name in (*FIRST, *CHANGING)]
    number = (known.keeps | known.changes).sum()
    moments = jax.tree.map(lambda part: jnp.asarray(part, None if part.dtype.kind != "f" else jnp.float32), moments)

    def value(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        off, slope = _mean_off(jnp.asarray(logarithms), moments, known)
        far = (logarithms - first) / wide
        return float(off) + far @ far / (2 * number), np.asarray(slope, dtype=float) + far / wide / number

    return optimize.minimize(value, first, jac=True, method="L-BFGS-B", options={"maxiter": 60, "ftol": 1e-6}).x


def _drivers(logarithms: Float[Any, "parameters"]) -> Drivers:
    """Return the drivers of what `_closest` found; they keep their lanes."""
    xp = logarithms.__array_namespace__()
    numbers, factors = xp.exp(logarithms[: len(FIRST)]), xp.exp(logarithms[len(FIRST) :])
    headway, *deviations, noise = numbers[len(LEARNED) :]
    median = xp.stack([xp.ones_like(headway), headway, xp.ones_like(headway)])
    changing = _changing(dict(zip(CHANGING, factors, strict=True)))
    prior = TraitPrior(median, xp.stack(deviations), noise)
    return Drivers(DrivingWeights(*numbers[: len(LEARNED)], COMFORT), prior, changing, Intention(-20.0, np.zeros(4)))


@jax.jit
@jax.value_and_grad
def _mean_off(logarithms: Float[jax.Array, "parameters"], moments: Moments, known: _Known) -> Float[jax.Array, ""]:
    """Return how far off drivers are, who drive on together to where they go: the mean of ``sqrt(1 + (e / s)^2) - 1``.

    Summed over along and across, and over the horizons at which a driver was seen.
    """
    drivers = _drivers(logarithms)

    def off(moment: Moments, known: _Known) -> tuple[jax.Array, jax.Array]:
        path = drive_together(drivers, moment, known.lane, known.changes)[HORIZONS - 1, :, :2]
        recorded = moment.future[HORIZONS - 1, :, :2]
        counts = jnp.isfinite(recorded).all(axis=-1) & (known.keeps | known.changes)
        error = jnp.where(counts[..., None], path - jnp.nan_to_num(recorded), 0.0) / SCALES[:, None]
        return jnp.sum(jnp.sqrt(1 + error**2) - 1), counts.sum()

    each, counts = jax.lax.map(lambda pair: off(*pair), (moments, known), batch_size=AT_ONCE)
    return each.sum() / counts.sum()


def _intention(moments: Moments, known: _Known) -> Intention:
    """Return the most likely intention, of logistic regression with a weak prior."""
    drawn, exist = map(np.asarray, jax.jit(jax.vmap(advantages))(jax.tree.map(jnp.asarray, moments)))
    now = lanes_of(np.asarray(moments.lanes), np.nan_to_num(np.asarray(moments.now)[..., 1]))
    sure = known.keeps | known.changes
    side = np.where(known.lane < now, 1, 2) * known.changes
    drawn, exist, side = drawn[sure].astype(float), exist[sure], side[sure]

    def surprise(numbers: np.ndarray) -> float:
        odds = np.where(exist, numbers[0] + drawn @ numbers[1:], -np.inf)
        odds = np.concatenate([np.zeros((len(odds), 1)), odds], axis=1)
        likely = odds[np.arange(len(side)), side] - special.logsumexp(odds, axis=1)
        return float(numbers @ numbers / (2 * ODDS**2) - likely.sum())

    found = optimize.minimize(surprise, np.array([-3.0, 0.0, 0.0, 0.0, 0.0])).x
    return Intention(float(found[0]), found[1:])
