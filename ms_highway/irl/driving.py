"""Predict drivers by what was learned of them: their traits from the past, then all of them together.

Nothing of the future is known, unless asked for: all cars that are seen at a moment drive on together, each for the
reward of its own traits, in closed loop at 10 Hz. What a driver does in each lane that it may want is then predicted
among the others that this gives.
"""

from functools import partial
from typing import Literal, NamedTuple, TypeAlias, get_args

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.learned_drivers import Intention, RewardTraits, TraitPrior
from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.moments import PAST, STEPS, Moments, lanes_of
from ms_highway.irl.outlook import SIDES, Modes
from ms_highway.planning.held_control import DrivingWeights, Leader, held_acceleration, held_curvature
from ms_highway.runtime.batches import in_batches

__all__ = ["Changing", "Drivers", "Others", "advantages", "drive_on", "drive_together", "expected_traits", "predict"]

Others: TypeAlias = Literal["predicted", "recorded", "coasting"]
"""Motion of the other cars: predicted together with the driver; as recorded, which leaks the future; at constant
velocity."""

SECOND = 10  # steps
EVERY = 2  # steps between the moments of the past at which plans are compared with what drivers did
CLIPPED = 3.0  # standard deviations, of surprises by which traits are updated
FARTHEST = 1.5  # of the logarithm of a trait from the median's
NOBODY = 60.0  # m, to a leader that is not seen, when lanes are compared
NEARNESS = 30.0  # m, by which a leader's speed counts less when lanes are compared
FAR = 1e4  # m


class Changing(NamedTuple):
    """Factors of the weights and traits of a driver who changes lanes."""

    weights: DrivingWeights
    desired_speed: float | Float[jax.Array, ""]
    headway: float | Float[jax.Array, ""]


class Drivers(NamedTuple):
    """What predictions need of `ms_highway.game.learned_drivers.LearnedDrivers` and of the learned weights.

    Attributes:
        weights: of the reward, at any common scale.
        prior: of the traits.
        changing: factors while changing lanes.
        intention: to change lanes.
    """

    weights: DrivingWeights
    prior: TraitPrior
    changing: Changing
    intention: Intention


class _Cars(NamedTuple):
    """All cars of one moment, absent ones far away."""

    x: Float[jax.Array, "cars"]
    y: Float[jax.Array, "cars"]
    heading: Float[jax.Array, "cars"]
    speed: Float[jax.Array, "cars"]
    present: Bool[jax.Array, "cars"]


def predict(moments: Moments, drivers: Drivers, others: Others = "predicted") -> Modes:
    """Predict the drivers of moments: keeping their lane, changing to the left, changing to the right.

    Args:
        moments: whose future is read only if the others move as recorded.
        drivers: what was learned.
        others: see `Others`.

    Raises:
        ValueError: if the motion of the others is unknown.
    """
    if others not in get_args(Others):
        raise ValueError(f"others are {others!r}; give one of {', '.join(get_args(Others))}")
    probability, path = in_batches(lambda some: _predict(drivers, some, others), moments)
    return Modes(moments.drivers(probability), moments.drivers(path))


@partial(jax.jit, static_argnums=2)
@partial(jax.vmap, in_axes=(None, 0, None))
def _predict(drivers: Drivers, moment: Moments, others: Others) -> tuple[jax.Array, jax.Array]:
    """Return the probability [cars, modes] and the path [cars, modes, steps, 2] of all modes of all cars."""
    cars, logarithms = _cars(moment.past[-1]), expected_traits(drivers, moment)[0]
    chance = _chances(drivers.intention, moment)
    wanted = moment.lanes[_lane(moment) + jnp.asarray(SIDES)[chance.argmax(axis=-1)]]
    around = _around(drivers, moment, cars, logarithms, wanted, others)

    def drive(side: Int[jax.Array, ""]) -> Float[jax.Array, "steps cars 4"]:
        lane = jnp.clip(_lane(moment) + side, 0, len(moment.lanes) - 1)
        changes = jnp.full(len(cars.x), side != 0)
        return drive_on(drivers, moment, cars, logarithms, moment.lanes[lane], changes, around)

    paths = jax.vmap(drive)(jnp.asarray(SIDES))
    return chance, jnp.moveaxis(paths, 2, 0)[..., :2]


def drive_on(
    drivers: Drivers,
    moment: Moments,
    cars: _Cars,
    logarithms: Float[jax.Array, "cars 3"],
    wanted: Float[jax.Array, "cars"],
    changes: Bool[jax.Array, "cars"],
    around: _Cars | None = None,
) -> Float[jax.Array, "50 cars 4"]:
    """Let all cars of one moment drive for 5 s; return their states after each step.

    Args:
        drivers: what was learned.
        moment: the road and the sizes of the cars.
        cars: where they are.
        logarithms: of their traits, as deviations from the medians'.
        wanted: lateral position of the lane that each wants [m].
        changes: who changes lanes, to follow the leader there.
        around: the others before each step, arrays [50, cars]; by default, all drive together.
    """
    weights, traits = _personal(drivers, logarithms, changes, moment.speed_limit)
    lengths = jnp.asarray(moment.sizes)[:, 0]

    @jax.checkpoint  # whose memory gradients of 5 s would exhaust
    def go(now: _Cars, others: _Cars | None) -> tuple[_Cars, Float[jax.Array, "cars 4"]]:
        middle = jnp.where(changes, wanted, now.y)
        leader = _leaders(now, now if others is None else others, middle, lengths, moment.lane_width)
        acceleration = held_acceleration(weights, traits, now.speed, leader)
        curvature = held_curvature(weights, now.y - wanted, now.heading, now.speed)
        speed = jnp.maximum(now.speed + acceleration * TIME_STEP, 0.0)
        distance = (now.speed + speed) / 2 * TIME_STEP
        x, y = now.x + distance * jnp.cos(now.heading), now.y + distance * jnp.sin(now.heading)
        after = _Cars(x, y, now.heading + curvature * distance, speed, now.present)
        return after, jnp.stack(after[:4], axis=-1)

    return jax.lax.scan(go, cars, around, length=STEPS)[1]


def drive_together(
    drivers: Drivers, moment: Moments, lane: Int[jax.Array, "cars"], changes: Bool[jax.Array, "cars"]
) -> Float[jax.Array, "50 cars 4"]:
    """Let all cars of one moment drive for 5 s with the traits that their past shows; return their states.

    Args:
        drivers: what was learned.
        moment: the start.
        lane: number of the lane that each goes to if it changes lanes; the others keep theirs.
        changes: who changes.
    """
    cars, logarithms = _cars(moment.past[-1]), expected_traits(drivers, moment)[0]
    wanted = jnp.asarray(moment.lanes)[jnp.where(changes, lane, _lane(moment))]
    return drive_on(drivers, moment, cars, logarithms, wanted, changes)


def expected_traits(
    drivers: Drivers, moment: Moments
) -> tuple[Float[jax.Array, "cars 3"], Float[jax.Array, "cars 3 3"]]:
    """Return mean and covariance of the logarithms of traits, as deviations from the medians', given the past 3 s.

    For each full second of a car's past, an extended Kalman update with its mean acceleration, which the plan of the
    traits predicts at the recorded states with the prior's noise. Surprises are clipped to 3 standard deviations.
    """
    prior, lengths = drivers.prior, jnp.asarray(moment.sizes)[:, 0]
    before = _Cars(*jax.vmap(_cars)(moment.past))
    leaders = jax.vmap(lambda cars: _leaders(cars, cars, cars.y, lengths, moment.lane_width))(before)
    mean = jnp.zeros((len(lengths), 3))
    covariance = jnp.broadcast_to(jnp.diag(jnp.asarray(prior.deviations) ** 2), (len(lengths), 3, 3))

    def expected(logarithms: jax.Array, speed: jax.Array, leader: Leader) -> jax.Array:
        traits = prior.traits(logarithms, moment.speed_limit)
        return held_acceleration(drivers.weights, traits, speed, leader).mean()

    def update(
        mean: jax.Array, covariance: jax.Array, speed: jax.Array, leader: Leader, gained: jax.Array, seen: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        predicted, slope = jax.value_and_grad(expected)(mean, speed, leader)
        variance = slope @ covariance @ slope + prior.noise**2
        most = CLIPPED * jnp.sqrt(variance)
        gain = covariance @ slope / variance
        moved = jnp.clip(mean + gain * jnp.clip(gained - predicted, -most, most), -FARTHEST, FARTHEST)
        narrowed = covariance - jnp.outer(gain, slope @ covariance)
        return jnp.where(seen, moved, mean), jnp.where(seen, narrowed, covariance)

    for first in range(0, PAST, SECOND):
        then = slice(first, first + SECOND, EVERY)
        seen = before.present[first : first + SECOND + 1].all(axis=0)
        gained = (before.speed[first + SECOND] - before.speed[first]) / (SECOND * TIME_STEP)
        leader = Leader(*(part[then].T for part in leaders))
        mean, covariance = jax.vmap(update)(mean, covariance, before.speed[then].T, leader, gained, seen)
    return mean, covariance


def advantages(moment: Moments) -> tuple[Float[jax.Array, "cars 2 6"], Bool[jax.Array, "cars 2"]]:
    """Return `Intention`'s advantages of the lanes to the left and to the right, and whether these exist."""
    cars, lane, lengths = _cars(moment.past[-1]), _lane(moment), jnp.asarray(moment.sizes)[:, 0]
    offset, drift = cars.y - moment.lanes[lane], cars.speed * jnp.sin(cars.heading)
    before = moment.past[-SECOND - 1 :, :, 1]
    times = TIME_STEP * (np.arange(SECOND + 1) - SECOND / 2)
    drifted = times @ before / (times @ times)
    drifted = jnp.where(jnp.isfinite(drifted), drifted, drift)
    own = _leaders(cars, cars, moment.lanes[lane], lengths, moment.lane_width)

    def side(right: int) -> tuple[jax.Array, jax.Array]:
        exists = (lane + right >= 0) & (lane + right <= _lane_of(moment, moment.lanes[-1]))
        there = moment.lanes[jnp.clip(lane + right, 0, len(moment.lanes) - 1)]
        other = _leaders(cars, cars, there, lengths, moment.lane_width)
        quicker = _hurry(other, cars.speed) - _hurry(own, cars.speed)
        room = jnp.clip(other.gap, 0.0, NOBODY) - jnp.clip(own.gap, 0.0, NOBODY)
        aside = [right * offset / moment.lane_width, right * drift, right * drifted]
        return jnp.stack([*aside, quicker, room / 10, cars.speed / 10], axis=-1), exists

    found, exist = zip(*map(side, (-1, 1)), strict=True)
    return jnp.stack(found, axis=1), jnp.stack(exist, axis=1)


def _hurry(leader: Leader, speed: Float[jax.Array, "cars"]) -> Float[jax.Array, "cars"]:
    """Return the speed of leaders relative to the followers, weighed by their nearness [m/s]."""
    near = jnp.where(leader.there, jnp.exp(-jnp.maximum(leader.gap, 0.0) / NEARNESS), 0.0)
    return near * (leader.speed - speed)


def _chances(intention: Intention, moment: Moments) -> Float[jax.Array, "cars modes"]:
    """Return the probability of each mode of each car."""
    drawn, exist = advantages(moment)
    odds = jnp.where(exist, jnp.asarray(intention.biases) + drawn @ jnp.asarray(intention.weights), -jnp.inf)
    return jax.nn.softmax(jnp.concatenate([jnp.zeros((len(odds), 1)), odds], axis=1), axis=1)


def _around(
    drivers: Drivers,
    moment: Moments,
    cars: _Cars,
    logarithms: Float[jax.Array, "cars 3"],
    wanted: Float[jax.Array, "cars"],
    others: Others,
) -> _Cars:
    """Return all cars before each step, as the others are expected to move, arrays [50, cars]."""
    if others == "recorded":
        return _Cars(*jax.vmap(_cars)(jnp.concatenate([moment.past[-1:], moment.future[:-1]])))
    if others == "coasting":
        times = TIME_STEP * jnp.arange(STEPS)[:, None]
        x = cars.x + times * cars.speed * jnp.cos(cars.heading)
        y = cars.y + times * cars.speed * jnp.sin(cars.heading)
        return _Cars(x, y, *(jnp.broadcast_to(part, x.shape) for part in cars[2:]))
    changes = wanted != moment.lanes[_lane(moment)]
    after = drive_on(drivers, moment, cars, logarithms, wanted, changes)
    states = jnp.concatenate([jnp.stack(cars[:4], axis=-1)[None], after[:-1]])
    x, y, heading, speed = jnp.moveaxis(states, -1, 0)
    return _Cars(x, y, heading, speed, jnp.broadcast_to(cars.present, x.shape))


def _personal(
    drivers: Drivers, logarithms: Float[jax.Array, "cars 3"], changes: Bool[jax.Array, "cars"], limit: jax.Array
) -> tuple[DrivingWeights, RewardTraits]:
    """Return the weights and traits of all cars."""
    factors = drivers.changing
    weights = DrivingWeights(
        *(
            weight * jnp.where(changes, factor, 1.0)
            for weight, factor in zip(drivers.weights, factors.weights, strict=True)
        )
    )
    traits = drivers.prior.traits(logarithms, limit)
    speed = traits.desired_speed * jnp.where(changes, factors.desired_speed, 1.0)
    return weights, RewardTraits(speed, traits.headway * jnp.where(changes, factors.headway, 1.0), traits.patience)


def _cars(states: Float[jax.Array, "cars 4"]) -> _Cars:
    present = jnp.isfinite(states).all(axis=-1)
    away = jnp.array([-FAR, -FAR, 0.0, 0.0])
    x, y, heading, speed = jnp.moveaxis(jnp.where(present[:, None], states, away), -1, 0)
    return _Cars(x, y, heading, speed, present)


def _lane(moment: Moments) -> Int[jax.Array, "cars"]:
    return _lane_of(moment, _cars(moment.past[-1]).y)


def _lane_of(moment: Moments, y: Float[jax.Array, "*cars"]) -> Int[jax.Array, "*cars"]:
    """Return numbers of lanes; of lanes that are repeated, the first's."""
    return lanes_of(jnp.asarray(moment.lanes), jnp.atleast_1d(y)).reshape(jnp.shape(y))


def _leaders(
    cars: _Cars,
    others: _Cars,
    middle: Float[jax.Array, "cars"],
    lengths: Float[jax.Array, "cars"],
    lane_width: Float[jax.Array, ""],
) -> Leader:
    """Return the nearest of the others ahead of each car and within half a lane of a lateral position."""
    distance = others.x[None, :] - cars.x[:, None]
    near = jnp.abs(others.y[None, :] - middle[:, None]) < lane_width / 2
    ahead = (distance > 0) & near & others.present[None, :] & ~jnp.eye(len(middle), dtype=bool)
    nearest = jnp.argmin(jnp.where(ahead, distance, jnp.inf), axis=1)
    gap = jnp.take_along_axis(distance, nearest[:, None], axis=1)[:, 0] - (lengths + lengths[nearest]) / 2
    there = ahead.any(axis=1)
    return Leader(jnp.where(there, gap, NOBODY), others.speed[nearest], there)
