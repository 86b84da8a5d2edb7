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

from ms_highway.game.learned_drivers import Drivers, LearnedDrivers, RewardTraits
from ms_highway.game.neighbours import Leader, leaders
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl import Others
from ms_highway.irl.arrays import CarFlags, CarNumbers, Cars, CarStates, Scalar, Traits
from ms_highway.irl.moments import PAST, STEPS, Moments, lanes_of
from ms_highway.irl.outlook import SIDES, Modes
from ms_highway.optimization.kalman import Gaussian, updated
from ms_highway.planning.held_control import held_acceleration, held_curvature
from ms_highway.runtime.compilation import in_batches

SECOND = 10  # steps
EVERY = 2  # steps between the moments of the past at which plans are compared with what drivers did
CLIPPED = 3.0  # standard deviations, of surprises by which traits are updated
FARTHEST = 1.5  # of the logarithm of a trait from the median's
NOBODY = 60.0  # m, to a leader that is not seen, when lanes are compared
NEARNESS = 30.0  # m, by which a leader's speed counts less when lanes are compared
FAR = 1e4  # m behind, where cars are that are not seen


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
    logarithms, (drawn, exist) = shown_traits(drivers, moment), lane_advantages(moment)
    odds = jnp.asarray(drivers.intention.biases) + drawn @ jnp.asarray(drivers.intention.weights)
    odds = jnp.where(exist, odds, -jnp.inf)
    chance = jax.nn.softmax(jnp.concatenate([jnp.zeros((len(odds), 1)), odds], axis=1), axis=1)
    sides = jnp.asarray(SIDES)
    around = _around(drivers, moment, logarithms, sides[chance.argmax(axis=-1)], others)
    paths = jax.vmap(lambda side: drive_on(drivers, moment, logarithms, jnp.full(len(chance), side), around))(sides)
    return Modes(chance, jnp.moveaxis(paths, 2, 0)[..., :2])


def _around(drivers: Drivers, moment: Moments, logarithms: Traits, side: CarNumbers, others: Others) -> CarStates:
    """Return the states of all cars before each step [50, cars, 4], as the others are expected to move."""
    now = _seen(moment.past[-1])
    if others == "recorded":
        return _seen(jnp.concatenate([moment.past[-1:], moment.future[:-1]]))
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

    def factor(name: str) -> Cars:
        return jnp.where(side != 0, drivers.changing.get(name, 1.0), 1.0)

    weights = {name: weight * factor(name) for name, weight in drivers.weights.items()}
    usual, wanted = drivers.prior.traits(logarithms, moment.speed_limit), _centre(moment, side)
    speeds, headways = usual.desired_speed * factor("desired speed"), usual.headway * factor("typical headway")
    traits = RewardTraits(speeds, headways, usual.patience)

    @jax.checkpoint  # whose memory gradients of 5 s would exhaust
    def go(now: CarStates, others: CarStates | None) -> tuple[CarStates, CarStates]:
        x, y, heading, speed = now.T
        leader = _leader(moment, now, now if others is None else others, jnp.where(side != 0, wanted, y))
        acceleration = held_acceleration(weights, traits, speed, leader)
        curvature = held_curvature(weights, y - wanted, heading, speed)
        faster = jnp.maximum(speed + acceleration * TIME_STEP, 0.0)
        distance = (speed + faster) / 2 * TIME_STEP
        ahead, aside = x + distance * jnp.cos(heading), y + distance * jnp.sin(heading)
        after = jnp.stack([ahead, aside, heading + curvature * distance, faster], axis=-1)
        return after, after

    return jax.lax.scan(go, _seen(moment.past[-1]), around, length=STEPS)[1]


def shown_traits(drivers: Drivers, moment: Moments) -> Traits:
    """Return the means of the logarithms of traits, as deviations from the medians', given the past 3 s.

    For each full second of a car's past, an extended Kalman update with its mean acceleration, which the plan of the
    traits predicts at the recorded states with the prior's noise. Surprises are clipped to 3 standard deviations.
    """
    prior, past, seen = drivers.prior, _seen(moment.past), jnp.isfinite(moment.past).all(axis=-1)
    speeds = past[..., 3]
    leader = jax.vmap(lambda states: _leader(moment, states, states, states[:, 1]))(past)
    cars = past.shape[1]
    traits = Gaussian(jnp.zeros((cars, 3)), jnp.tile(jnp.diag(jnp.asarray(prior.deviations) ** 2), (cars, 1, 1)))

    def expected(logarithms: Traits, speed: Cars, leader: Leader) -> Scalar:
        usual = prior.traits(logarithms, moment.speed_limit)
        return held_acceleration(drivers.weights, usual, speed, leader).mean()

    def update(traits: Gaussian, speed: Cars, leader: Leader, gained: Scalar, seen: jax.Array) -> Gaussian:
        predicted, slope = jax.value_and_grad(expected)(traits.mean, speed, leader)
        after, _ = updated(traits, slope, gained - predicted, prior.noise**2, CLIPPED)
        after = after._replace(mean=jnp.clip(after.mean, -FARTHEST, FARTHEST))
        return jax.tree.map(partial(jnp.where, seen), after, traits)

    for first in range(0, PAST, SECOND):
        then, last = slice(first, first + SECOND, EVERY), first + SECOND
        gained = (speeds[last] - speeds[first]) / (SECOND * TIME_STEP)
        led = Leader(*(part[then].T for part in leader))
        traits = jax.vmap(update)(traits, speeds[then].T, led, gained, seen[first : last + 1].all(axis=0))
    return traits.mean


def lane_advantages(moment: Moments) -> tuple[CarStates, CarFlags]:
    """Return the ``lane_advantages`` of the lanes to the left and right [cars, 2, 6], and whether these exist."""
    states, centre = _seen(moment.past[-1]), _centre(moment, 0)
    _, y, heading, speed = states.T
    drift = speed * jnp.sin(heading)
    times = TIME_STEP * (np.arange(SECOND + 1) - SECOND / 2)
    drifted = times @ moment.past[-SECOND - 1 :, :, 1] / (times @ times)
    drifted = jnp.where(jnp.isfinite(drifted), drifted, drift)
    own = _leader(moment, states, states, centre)

    def hurry(leader: Leader) -> Cars:
        """Return the speed of leaders relative to the followers, weighed by their nearness [m/s]."""
        near = jnp.where(leader.there, jnp.exp(-jnp.maximum(leader.gap, 0.0) / NEARNESS), 0.0)
        return near * (leader.speed - speed)

    def side(right: int) -> tuple[jax.Array, CarFlags]:
        there = _centre(moment, right)
        other = _leader(moment, states, states, there)
        room = jnp.clip(other.gap, 0.0, NOBODY) - jnp.clip(own.gap, 0.0, NOBODY)
        aside = [right * (y - centre) / moment.lane_width, right * drift, right * drifted]
        return jnp.stack([*aside, hurry(other) - hurry(own), room / 10, speed / 10], axis=-1), there != centre

    found, exist = zip(*map(side, (-1, 1)), strict=True)
    return jnp.stack(found, axis=1), jnp.stack(exist, axis=1)


def _seen(states: CarStates) -> CarStates:
    """Return states in which cars that are not seen stand far behind."""
    return jnp.where(jnp.isfinite(states).all(axis=-1, keepdims=True), states, jnp.array([-FAR, -FAR, 0.0, 0.0]))


def _centre(moment: Moments, side: int | CarNumbers) -> Cars:
    """Return the lateral position of the lane that is so many to the right of each car's, or of its own at the edge."""
    lane = lanes_of(moment.lanes, _seen(moment.past[-1])[:, 1])
    return moment.lanes[jnp.clip(lane + side, 0, len(moment.lanes) - 1)]


def _leader(moment: Moments, states: CarStates, others: CarStates, lane: Cars) -> Leader:
    """Return the nearest of the others ahead of each car in the lane with this lateral position."""
    not_itself, lengths = ~jnp.eye(len(states), dtype=bool), moment.sizes[:, 0]
    place, there = leaders(states[:, 0], lane, others, not_itself, moment.lane_width / 2)
    gap = others[place, 0] - states[:, 0] - (lengths + lengths[place]) / 2
    return Leader(jnp.where(there, gap, NOBODY), others[place, 3], there)
