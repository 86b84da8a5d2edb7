"""Predict drivers by Kalman filters over modes that follow lanes: interacting multiple models (IMM).

A driver keeps its lane or changes to the left or to the right one. In each mode its lateral position is drawn to the
centre of that lane like a damped spring; along the road it keeps its speed, and its acceleration fades. The filters
run over the recorded past (Blom and Bar-Shalom 1988), and the modes' means are predicted from there.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.learned_drivers import Spread
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.arrays import Parameters, Paths, Scalar, Steps
from ms_highway.irl.moments import STEPS, Moments, lanes_of
from ms_highway.irl.outlook import EVERY, SIDES, Modes, log_density
from ms_highway.optimization.estimation import minimum
from ms_highway.optimization.kalman import Gaussian, apply, mixed, predicted, updated
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.structures import Finite, Structure, pytree

FIRST_SPREAD = (-0.7, 1.3, 0.0, -1.8, 0.9, 0.0, 0.0, 0.0, 1.5)  # as in `ms_highway.irl.outlook`
EVALUATIONS = 30


@pytree
class KalmanSettings(Structure):
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

    keeping: Finite
    changing: Finite
    calm: Finite
    sway: Finite
    across: Finite
    drift: Finite
    beginning: Finite
    ending: Finite
    push: Finite
    along: Finite
    pace: Finite
    fading: Finite


FIRST_KALMAN = KalmanSettings(0.1, 0.4, 1.0, 1.0, 0.03, 0.1, 0.05, 0.5, 10.0, 0.1, 0.03, 3.0)
"""Settings that a fit starts from."""

FIRST_DEVIATIONS = np.array([0.5, 0.4])  # m and m/s, lateral, of drivers seen for the first time
LEAST = 1e-9  # probability of a mode
CHANGE_SPEED = 0.6  # m/s, lateral, of those who change lanes


class _Past(NamedTuple):
    """The past of n drivers: what was measured, and the lanes that they may follow.

    Attributes:
        seen: whether the driver was seen from that step until now [31, n].
        along: x less that of now, and its rate of change [31, 2, n].
        across: y and its rate of change [31, 2, n].
        centres: lateral position of the lane of each mode; of the driver's own for lanes that do not exist [3, n].
        exists: whether there is a lane [3, n].
        x: along the road, now.
    """

    seen: jax.Array
    along: jax.Array
    across: jax.Array
    centres: jax.Array
    exists: jax.Array
    x: jax.Array


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
    positions = moments.recorded
    known = np.isfinite(positions).all(axis=-1)[:, EVERY - 1 :: EVERY]
    first = np.concatenate([np.log(jax.tree.leaves(FIRST_KALMAN)), FIRST_SPREAD])
    given = map(jnp.asarray, (np.nan_to_num(positions), known))
    found = minimum(_unlikeliness, first, _past(moments), *given, maxfun=evaluations)
    return KalmanSettings(*np.exp(found[: -len(FIRST_SPREAD)]).tolist())


@jit_quickly
@jax.value_and_grad
def _unlikeliness(parameters: Parameters, past: _Past, positions: Paths, known: Steps) -> Scalar:
    """Return minus the mean log density of the known positions."""
    own, rest = parameters[: -len(FIRST_SPREAD)], parameters[-len(FIRST_SPREAD) :]
    spread = Spread(rest[:3], rest[3:6], rest[6:8], jnp.array([jnp.exp(rest[8]), 0.0]))  # type: ignore[arg-type]
    each = log_density(_modes(KalmanSettings(*jnp.exp(own)), past), spread, positions)[:, EVERY - 1 :: EVERY]
    return -jnp.sum(jnp.where(known, each, 0.0)) / jnp.sum(known)


def _past(moments: Moments) -> _Past:
    past = moments.tracks(moments.past)
    seen = np.logical_and.accumulate(np.isfinite(past).all(axis=-1)[:, ::-1], axis=1)[:, ::-1]
    x, y, heading, speed = np.moveaxis(np.where(seen[..., None], past, past[:, -1:]), -1, 0)
    lanes = moments.lanes[moments.which]
    lane = lanes_of(lanes, y[:, -1:])
    centres = np.take_along_axis(lanes, np.clip(lane + SIDES, 0, lanes.shape[1] - 1), axis=1)
    exists = (SIDES == 0) | (centres != centres[:, :1])
    along = np.stack([x - x[:, -1:], speed * np.cos(heading)], axis=-1)
    across = np.stack([y, speed * np.sin(heading)], axis=-1)
    parts = seen, along, across, centres, exists, x[:, -1]
    return _Past(*(jnp.asarray(np.moveaxis(part, 0, -1)) for part in parts))


def _modes(settings: KalmanSettings, past: _Past) -> Modes:
    """Return the modes, with the probabilities and the means of the filters."""
    coast, spring = _transitions(settings)
    along, across, probability = _filtered(settings, past, coast, spring)

    def go(state: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        ahead, offset = apply(coast, state[0]), apply(spring, state[1])
        x = jnp.broadcast_to(past.x + ahead[0], past.centres.shape)
        return (ahead, offset), jnp.stack([x, past.centres + offset[0]])

    start = along.mean, across.mean.at[0].add(-past.centres)
    path = jax.lax.scan(go, start, None, length=STEPS)[1]
    return Modes(probability.T, path.transpose(3, 2, 0, 1))


_compiled_modes = jit_quickly(_modes)


def _transitions(settings: KalmanSettings) -> tuple[jax.Array, jax.Array]:
    """Return the transitions, in a step, of position, speed and acceleration along the road [3, 3, 1].

    And of offset and lateral speed in each mode [2, 2, 3, 1].
    """
    dt, change = TIME_STEP, settings.changing
    coast = jnp.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, jnp.exp(-dt * settings.fading)]])
    pull, decay = dt * jnp.array([settings.keeping, change, change]), 2 * jnp.sqrt(change)
    damped = 1 - dt * jnp.array([settings.calm, decay, decay])
    spring = jnp.array([[1 - dt * pull, dt * damped], [-pull, damped]])
    return coast[..., None], spring[..., None]


def _filtered(
    settings: KalmanSettings, past: _Past, coast: jax.Array, spring: jax.Array
) -> tuple[Gaussian, Gaussian, jax.Array]:
    """Return the states along the road, across it in every mode, and the modes' probabilities [3, n].

    By interacting multiple models.
    """
    centres, pushed = past.centres, jnp.zeros((3, 3, 1)).at[2, 2].set(settings.push**2)
    swaying = jnp.zeros((2, 2, 1, 1)).at[1, 1].set((TIME_STEP * settings.sway) ** 2)
    left, right = TIME_STEP * settings.beginning * past.exists[1:]
    end, zero = jnp.full_like(left, TIME_STEP * settings.ending), jnp.zeros_like(left)
    switch = jnp.array([[1 - left - right, left, right], [end, 1 - end, zero], [end, zero, 1 - end]])  # from, to

    def go(state: tuple[Gaussian, Gaussian, jax.Array], given: tuple[jax.Array, ...]) -> tuple[Any, None]:
        along, across, probability = state
        seen, here, there = given
        joint = probability[:, None] * switch
        after = jnp.sum(joint, axis=0)
        possible = after > LEAST
        before = mixed(across, jnp.where(possible, joint / jnp.where(possible, after, 1.0), jnp.eye(3)[..., None]))
        ahead = predicted(before._replace(mean=before.mean.at[0].add(-centres)), spring, swaying)
        ahead = ahead._replace(mean=ahead.mean.at[0].add(centres))
        ahead, likelihood = _after_measuring(ahead, there, settings.across, settings.drift)
        likely = after * jnp.exp(likelihood - jnp.max(likelihood, axis=0)) + LEAST * past.exists
        moved, _ = _after_measuring(predicted(along, coast, pushed), here, settings.along, settings.pace)
        new = moved, ahead, likely / jnp.sum(likely, axis=0)
        return jax.tree.map(partial(jnp.where, seen), new, state), None

    first = jnp.take_along_axis(past.along, jnp.argmax(past.seen, axis=0)[None, None], axis=0)[0]
    aside = centres - centres[0]
    along = jnp.concatenate([first, jnp.zeros_like(first[:1])])
    across = jnp.stack([centres[0] + aside / 4, CHANGE_SPEED * jnp.sign(aside)])
    wide = jnp.broadcast_to(jnp.eye(3)[..., None], (3, *along.shape))
    narrow = jnp.broadcast_to(jnp.diag(FIRST_DEVIATIONS**2)[..., None, None], (2, *across.shape))
    share = settings.beginning / (settings.beginning + settings.ending)
    prior = jnp.where(past.exists, jnp.array([1.0, share, share])[:, None], 0.0)
    start = Gaussian(along, wide), Gaussian(across, narrow), prior / jnp.sum(prior, axis=0)
    return jax.lax.scan(go, start, (past.seen, past.along, past.across))[0]


def _after_measuring(belief: Gaussian, values: jax.Array, *deviations: Any) -> tuple[Gaussian, jax.Array]:
    """Return the distribution after a measurement of its first two variables, and the log density of that."""
    total = jnp.zeros(())
    for place, deviation in enumerate(deviations):
        belief, density = updated(belief, place, values[place] - belief.mean[place], deviation**2)
        total += density
    return belief, total
