"""Predict drivers by what was learned of them: their traits from the past, then all of them together.

Nothing of the future is known, unless asked for: all cars that are seen at a moment drive on together, each for the
reward of its own traits, in closed loop at 10 Hz. What a driver does in each lane that it may want is then predicted
among the others that this gives.
"""

from functools import partial
from typing import get_args

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.learned_drivers import Drivers, LearnedDrivers
from ms_highway.game.neighbours import Leader
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl import Others
from ms_highway.irl.arrays import CarFlags, CarNumbers, Cars, CarStates, Traits
from ms_highway.irl.moments import STEPS, Moments, lanes_of
from ms_highway.irl.outlook import SIDES, Modes
from ms_highway.planning.learned_driving import NOBODY, SECOND, leader_of, moved, seen_states, shown_traits
from ms_highway.runtime.compilation import in_batches

NEARNESS = 30.0  # m, by which a leader's speed counts less when lanes are compared


def predict(moments: Moments, drivers: Drivers, others: Others = "predicted") -> Modes:
    """Predict the drivers of moments: keeping their lane, changing to the left, changing to the right.

    Args:
        moments: whose future is read only if the others move as recorded.
        drivers: what was learned; of `LearnedDrivers`, as they come with the package, the drivers alone.
        others: see `Others`.

    Raises:
        ValueError: if the motion of the others is unknown.
    """
    if others not in get_args(Others):
        raise ValueError(f"others are {others!r}; give one of {', '.join(get_args(Others))}")
    bare = drivers.bare if isinstance(drivers, LearnedDrivers) else drivers
    modes = in_batches(lambda some: _all_modes(bare, some, others), moments)
    return Modes(*map(moments.drivers, modes))


@partial(jax.jit, static_argnums=2)
@partial(jax.vmap, in_axes=(None, 0, None))
def _all_modes(drivers: Drivers, moment: Moments, others: Others) -> Modes:
    """Return all modes of all cars."""
    logarithms, (drawn, exist) = shown_traits(drivers, moment, moment.past), lane_advantages(moment)
    odds = jnp.asarray(drivers.intention.biases) + drawn @ jnp.asarray(drivers.intention.weights)
    odds = jnp.where(exist, odds, -jnp.inf)
    chance = jax.nn.softmax(jnp.concatenate([jnp.zeros((len(odds), 1)), odds], axis=1), axis=1)
    sides = jnp.asarray(SIDES)
    around = _around(drivers, moment, logarithms, sides[chance.argmax(axis=-1)], others)
    paths = jax.vmap(lambda side: drive_on(drivers, moment, logarithms, jnp.full(len(chance), side), around))(sides)
    return Modes(chance, jnp.moveaxis(paths, 2, 0)[..., :2])


def _around(drivers: Drivers, moment: Moments, logarithms: Traits, side: CarNumbers, others: Others) -> CarStates:
    """Return the states of all cars before each step [50, cars, 4], as the others are expected to move."""
    now = seen_states(moment.past[-1])
    if others == "recorded":
        return seen_states(jnp.concatenate([moment.past[-1:], moment.future[:-1]]))
    if others == "coasting":
        _, _, heading, speed = now.T
        still = jnp.zeros_like(speed)
        velocity = jnp.stack([speed * jnp.cos(heading), speed * jnp.sin(heading), still, still], axis=-1)
        return now + TIME_STEP * jnp.arange(STEPS)[:, None, None] * velocity
    after = drive_on(drivers, moment, logarithms, side)
    return jnp.concatenate([now[None], after[:-1]])


def drive_on(
    drivers: Drivers, moment: Moments, logarithms: Traits, side: CarNumbers, around: CarStates | None = None
) -> CarStates:
    """Let all cars of one moment drive for 5 s; return their states after each step [50, cars, 4].

    Args:
        drivers: what was learned.
        moment: the start.
        logarithms: of their traits, see `shown_traits`.
        side: lanes to the right by which each changes lanes, -1, 0 or 1; who changes follows the leader there.
        around: all cars before each step [50, cars, 4], of which each meets the others; by default, all drive together.
    """
    wanted = _centre(moment, side)

    @jax.checkpoint  # whose memory gradients of 5 s would exhaust
    def go(now: CarStates, others: CarStates | None) -> tuple[CarStates, CarStates]:
        after, _ = moved(drivers, moment, logarithms, side, wanted, now, others)
        return after, after

    return jax.lax.scan(go, seen_states(moment.past[-1]), around, length=STEPS)[1]


def lane_advantages(moment: Moments) -> tuple[CarStates, CarFlags]:
    """Return the ``lane_advantages`` of the lanes to the left and right [cars, 2, 6], and whether these exist."""
    states, centre = seen_states(moment.past[-1]), _centre(moment, 0)
    _, y, heading, speed = states.T
    drift = speed * jnp.sin(heading)
    times = TIME_STEP * (np.arange(SECOND + 1) - SECOND / 2)
    drifted = times @ moment.past[-SECOND - 1 :, :, 1] / (times @ times)
    drifted = jnp.where(jnp.isfinite(drifted), drifted, drift)
    own = leader_of(moment, states, states, centre)

    def hurry(leader: Leader) -> Cars:
        """Return the speed of leaders relative to the followers, weighed by their nearness [m/s]."""
        near = jnp.where(leader.there, jnp.exp(-jnp.maximum(leader.gap, 0.0) / NEARNESS), 0.0)
        return near * (leader.speed - speed)

    def side(right: int) -> tuple[jax.Array, CarFlags]:
        there = _centre(moment, right)
        other = leader_of(moment, states, states, there)
        room = jnp.clip(other.gap, 0.0, NOBODY) - jnp.clip(own.gap, 0.0, NOBODY)
        aside = [right * (y - centre) / moment.lane_width, right * drift, right * drifted]
        return jnp.stack([*aside, hurry(other) - hurry(own), room / 10, speed / 10], axis=-1), there != centre

    found, exist = zip(*map(side, (-1, 1)), strict=True)
    return jnp.stack(found, axis=1), jnp.stack(exist, axis=1)


def _centre(moment: Moments, side: int | CarNumbers) -> Cars:
    """Return the lateral position of the lane that is so many to the right of each car's, or of its own at the edge."""
    lane = lanes_of(moment.lanes, seen_states(moment.past[-1])[:, 1])
    return moment.lanes[jnp.clip(lane + side, 0, len(moment.lanes) - 1)]
