"""Predict drivers by Kalman filters over modes that follow lanes: interacting multiple models (IMM).

A driver keeps its lane or changes to the left or to the right one. In each mode its lateral position is drawn to the
centre of that lane like a damped spring; along the road it keeps its speed, and its acceleration fades. The filters
run over the recorded past (Blom and Bar-Shalom 1988), and the modes' means are predicted from there.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float
from scipy import optimize

from ms_highway.game.learned_drivers import Spread
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.moments import STEPS, Moments, lanes_of
from ms_highway.irl.outlook import SIDES, Modes, log_density
from ms_highway.runtime.compilation import jit_quickly

__all__ = ["FIRST_KALMAN", "KalmanSettings", "fit_kalman", "lane_modes"]

EVERY = 5  # steps between those at which predictions count in a fit
FIRST_SPREAD = (-0.7, 1.3, 0.0, -1.8, 0.9, 0.0, 0.0, 0.0, 1.5)  # as in `ms_highway.irl.outlook`
EVALUATIONS = 30


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KalmanSettings:
    """Dynamics, noise and switching of the modes; noise as standard deviations, of each step of 0.1 s.

    Attributes:
        keeping: pull to the centre of the driver's lane [1/s^2].
        changing: pull to the centre of the lane that a driver changes to [1/s^2]; critically damped.
        calm: decay of the lateral speed of drivers who keep their lane [1/s].
        sway: lateral acceleration [m/s^2].
        across: measured lateral position [m].
        drift: measured lateral speed [m/s].
        beginning: probability, in a second, to begin a change to a given side.
        ending: probability, in a second, to end a change.
        push: change of the acceleration [m/s^2].
        along: measured position along the road [m].
        pace: measured speed [m/s].
        fading: decay of the acceleration [1/s].
    """

    keeping: float | Float[Any, ""]
    changing: float | Float[Any, ""]
    calm: float | Float[Any, ""]
    sway: float | Float[Any, ""]
    across: float | Float[Any, ""]
    drift: float | Float[Any, ""]
    beginning: float | Float[Any, ""]
    ending: float | Float[Any, ""]
    push: float | Float[Any, ""]
    along: float | Float[Any, ""]
    pace: float | Float[Any, ""]
    fading: float | Float[Any, ""]


FIRST_KALMAN = KalmanSettings(0.1, 0.4, 1.0, 1.0, 0.03, 0.1, 0.05, 0.5, 10.0, 0.1, 0.03, 3.0)
"""Settings that a fit starts from."""

FIRST_DEVIATIONS = np.array([0.5, 0.4])  # m and m/s, lateral, of drivers seen for the first time
LEAST = 1e-9  # probability of a mode
CHANGE_SPEED = 0.6  # m/s, lateral, of those who change lanes


class _Past(NamedTuple):
    """The past of n drivers: what was measured, relative to now, and the lanes that they may follow.

    Attributes:
        seen: whether the driver was seen from that step until now.
        along: x less that of now, and its rate of change.
        across: y and its rate of change.
        centres: lateral position of the lane of each mode; of the driver's own for lanes that do not exist.
        exists: whether there is a lane.
        x: along the road, now.
    """

    seen: Bool[jax.Array, "31 n"]
    along: Float[jax.Array, "31 2 n"]
    across: Float[jax.Array, "31 2 n"]
    centres: Float[jax.Array, "3 n"]
    exists: Bool[jax.Array, "3 n"]
    x: Float[jax.Array, "n"]


class _Belief(NamedTuple):
    """Normal distributions of states of m components, the first two of which are measured."""

    mean: Float[jax.Array, "m *batch"]
    covariance: Float[jax.Array, "m m *batch"]


def lane_modes(moments: Moments, settings: KalmanSettings) -> Modes:
    """Predict drivers who keep their lane (mode 0) or change to the left (1) or to the right one (2).

    Changes to lanes that do not exist have probability 0, and the path that keeps the lane.
    """
    return _compiled_modes(settings, _past(moments))


def fit_kalman(moments: Moments, evaluations: int = EVALUATIONS) -> KalmanSettings:
    """Fit the settings that make recorded positions most likely, with a `Spread` that is fitted beside them.

    Args:
        moments: to fit to; the only use of their future.
        evaluations: of the likelihood, at most.
    """
    positions = moments.drivers(np.moveaxis(np.asarray(moments.future)[..., :2], 1, 2))
    past, known = _past(moments), np.isfinite(positions).all(axis=-1)[:, EVERY - 1 :: EVERY]
    positions, known = jnp.asarray(np.nan_to_num(positions)), jnp.asarray(known)

    def value(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        surprise, slope = _surprise(parameters, past, positions, known)
        return float(surprise), np.asarray(slope, dtype=float)

    first = np.concatenate([np.log(jax.tree.leaves(FIRST_KALMAN)), FIRST_SPREAD])
    found = optimize.minimize(value, first, jac=True, method="L-BFGS-B", options={"maxfun": evaluations})
    return KalmanSettings(*map(float, np.exp(found.x[: -len(FIRST_SPREAD)])))


@jit_quickly
def _surprise(
    parameters: Float[jax.Array, "21"],
    past: _Past,
    positions: Float[jax.Array, "n 50 2"],
    known: Bool[jax.Array, "n few"],
) -> tuple[Float[jax.Array, ""], Float[jax.Array, "21"]]:
    """Return minus the mean log density of the known positions, and its gradient."""

    def surprise(parameters: jax.Array) -> jax.Array:
        own, rest = parameters[: -len(FIRST_SPREAD)], parameters[-len(FIRST_SPREAD) :]
        spread = Spread(rest[:3], rest[3:6], rest[6:8], jnp.stack([jnp.exp(rest[8]), jnp.zeros(())]))
        each = log_density(_modes(KalmanSettings(*jnp.exp(own)), past), spread, positions)[:, EVERY - 1 :: EVERY]
        return -jnp.sum(jnp.where(known, each, 0.0)) / jnp.sum(known)

    return jax.value_and_grad(surprise)(parameters)


def _past(moments: Moments) -> _Past:
    past = moments.drivers(np.moveaxis(np.asarray(moments.past), 1, 2))
    seen = np.logical_and.accumulate(np.isfinite(past).all(axis=-1)[:, ::-1], axis=1)[:, ::-1]
    x, y, heading, speed = np.moveaxis(np.where(seen[..., None], past, past[:, -1:]), -1, 0)
    lanes = np.repeat(np.asarray(moments.lanes), np.sum(moments.predicted, axis=1), axis=0)
    lane = lanes_of(lanes, y[:, -1:])
    beside = np.clip(lane + SIDES, 0, lanes.shape[1] - 1)
    centres, own = np.take_along_axis(lanes, beside, axis=1), np.take_along_axis(lanes, lane, axis=1)
    exists = (SIDES == 0) | (np.sign(centres - own) == SIDES)
    along = np.stack([x - x[:, -1:], speed * np.cos(heading)], axis=-1)
    across = np.stack([y, speed * np.sin(heading)], axis=-1)
    parts = seen, along, across, np.where(exists, centres, own), exists, x[:, -1]
    return _Past(*(jnp.asarray(np.moveaxis(part, 0, -1)) for part in parts))


def _modes(settings: KalmanSettings, past: _Past) -> Modes:
    """Return the modes, with the probabilities and the means of the filters."""
    coast, spring, centres = _coast(settings), _spring(settings), past.centres
    across, probability = _filter_across(settings, past)

    def go(state: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        ahead, offset = _apply(coast, state[0]), _apply(spring, state[1])
        return (ahead, offset), jnp.stack([jnp.broadcast_to(past.x + ahead[0], centres.shape), centres + offset[0]])

    start = _filter_along(settings, past).mean, across.mean.at[0].add(-centres)
    path = jax.lax.scan(go, start, None, length=STEPS)[1]
    return Modes(probability.T, path.transpose(3, 2, 0, 1))


_compiled_modes = jit_quickly(_modes)


def _spring(settings: KalmanSettings) -> Float[jax.Array, "2 2 3 1"]:
    """Return the transition of offset and lateral speed in each mode."""
    pull, decay = (
        jnp.stack([jnp.asarray(keep), *[jnp.asarray(change)] * 2])
        for keep, change in ((settings.keeping, settings.changing), (settings.calm, 2 * jnp.sqrt(settings.changing)))
    )
    later = jnp.stack([-TIME_STEP * pull, 1 - TIME_STEP * decay])
    return jnp.stack([TIME_STEP * later + jnp.array([[1.0], [0.0]]), later])[..., None]


def _coast(settings: KalmanSettings) -> Float[jax.Array, "3 3 1"]:
    """Return the transition of position, speed and acceleration along the road."""
    plain = jnp.array([[1.0, TIME_STEP, TIME_STEP**2 / 2], [0.0, 1.0, TIME_STEP], [0.0, 0.0, 1.0]])
    return plain.at[2, 2].set(jnp.exp(-TIME_STEP * settings.fading))[..., None]


def _filter_along(settings: KalmanSettings, past: _Past) -> _Belief:
    """Return the position, the speed and the acceleration along the road."""
    transition, noise = _coast(settings), jnp.zeros((3, 3, 1)).at[2, 2].set(settings.push**2)
    measured = jnp.stack([settings.along, settings.pace]) ** 2
    first = jnp.take_along_axis(past.along, jnp.argmax(past.seen, axis=0)[None, None], axis=0)[0]
    mean = jnp.concatenate([first, jnp.zeros_like(first[:1])])
    belief = _Belief(mean, jnp.broadcast_to(jnp.eye(3)[..., None], (3, *mean.shape)))

    def go(belief: _Belief, given: tuple[jax.Array, jax.Array]) -> tuple[_Belief, None]:
        seen, values = given
        updated = _updated(_predicted(belief, transition, noise), values, measured)[0]
        return jax.tree.map(partial(jnp.where, seen), updated, belief), None

    return jax.lax.scan(go, belief, (past.seen, past.along))[0]


def _filter_across(settings: KalmanSettings, past: _Past) -> tuple[_Belief, Float[jax.Array, "3 n"]]:
    """Return the lateral states in every mode, and the probabilities of the modes, by interacting multiple models."""
    transition, switch = _spring(settings), _switch(settings, past)
    noise = jnp.zeros((2, 2, 1, 1)).at[1, 1].set((TIME_STEP * settings.sway) ** 2)
    measured = jnp.stack([settings.across, settings.drift]) ** 2
    centres = past.centres
    aside = centres - centres[0]
    mean = jnp.stack([centres[0] + aside / 4, CHANGE_SPEED * jnp.sign(aside)])
    belief = _Belief(mean, jnp.broadcast_to(jnp.diag(FIRST_DEVIATIONS**2)[..., None, None], (2, *mean.shape)))
    share = settings.beginning / (settings.beginning + settings.ending)
    prior = jnp.where(past.exists, jnp.stack([jnp.ones_like(share), share, share])[:, None], 0.0)

    def go(state: tuple[_Belief, jax.Array], given: tuple[jax.Array, jax.Array]) -> tuple[Any, None]:
        belief, probability = state
        seen, values = given
        joint = probability[:, None] * switch
        after = jnp.sum(joint, axis=0)
        possible = after > LEAST
        mixed = _mixed(belief, jnp.where(possible, joint / jnp.where(possible, after, 1.0), jnp.eye(3)[..., None]))
        ahead = _predicted(mixed._replace(mean=mixed.mean.at[0].add(-centres)), transition, noise)
        ahead = ahead._replace(mean=ahead.mean.at[0].add(centres))
        updated, likelihood = _updated(ahead, values[:, None], measured)
        likely = after * jnp.exp(likelihood - jnp.max(likelihood, axis=0)) + LEAST * past.exists
        new = updated, likely / jnp.sum(likely, axis=0)
        return jax.tree.map(partial(jnp.where, seen), new, state), None

    return jax.lax.scan(go, (belief, prior / jnp.sum(prior, axis=0)), (past.seen, past.across))[0]


def _switch(settings: KalmanSettings, past: _Past) -> Float[jax.Array, "3 3 n"]:
    """Return the probabilities to switch from a mode to another within a step."""
    left, right = TIME_STEP * settings.beginning * past.exists[1:]
    end, zero = jnp.full_like(left, TIME_STEP * settings.ending), jnp.zeros_like(left)
    rows = [1 - left - right, left, right], [end, 1 - end, zero], [end, zero, 1 - end]
    return jnp.stack([jnp.stack(row) for row in rows])


def _mixed(belief: _Belief, weights: Float[jax.Array, "3 3 n"]) -> _Belief:
    """Return the normal distributions with the moments of mixtures, with weights [from, to]."""
    mean = jnp.sum(weights * belief.mean[:, :, None], axis=1)
    off = belief.mean[:, :, None] - mean[:, None]
    return _Belief(mean, jnp.sum(weights * (belief.covariance[:, :, :, None] + off[:, None] * off), axis=2))


def _predicted(belief: _Belief, transition: jax.Array, noise: jax.Array) -> _Belief:
    half = _product(transition, belief.covariance)
    return _Belief(_apply(transition, belief.mean), _product(half, jnp.swapaxes(transition, 0, 1)) + noise)


def _updated(belief: _Belief, values: jax.Array, variances: jax.Array) -> tuple[_Belief, jax.Array]:
    """Return the distribution after a measurement of the first two components, and the log likelihood of that."""
    mean, covariance = belief
    a, b, d = covariance[0, 0] + variances[0], covariance[0, 1], covariance[1, 1] + variances[1]
    determinant = a * d - b**2
    inverse = jnp.stack([jnp.stack([d, -b]), jnp.stack([-b, a])]) / determinant
    off = values - mean[:2]
    gain = _product(covariance[:, :2], inverse)
    likelihood = -(jnp.sum(off * _apply(inverse, off), axis=0) + jnp.log(determinant)) / 2
    return _Belief(mean + _apply(gain, off), covariance - _product(gain, covariance[:2])), likelihood


def _apply(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Multiply matrices [i, j, ...] by vectors [j, ...]; XLA vectorises over the last axis, the drivers."""
    return jnp.sum(matrix * vector, axis=1)


def _product(left: jax.Array, right: jax.Array) -> jax.Array:
    """Multiply matrices [i, j, ...] by matrices [j, k, ...], likewise."""
    return jnp.sum(left[:, :, None] * right, axis=1)
