"""Let recorded drivers drive on together, each by the traits that it has shown."""

from typing import Any

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.data.learned_drivers import Drivers, RewardTraits
from ms_highway.game.scenario import TIME_STEP
from ms_highway.game.scene import Leader, leaders
from ms_highway.irl.snapshots import PAST_STEPS, STEPS, Snapshots
from ms_highway.planning.learned_driving import (
    HELD_CONTROL,
    held_acceleration,
    held_curvature,
)
from ms_highway.runtime.arrays import Scalar

STEPS_PER_SECOND = 10
"""Steps of a second."""

STRIDE = 2
"""Steps between the past times at which plans are compared with recorded driving."""

MAX_SURPRISE = 3.0  # standard deviations, to which surprises are clipped
MAX_DEVIATION = 1.5  # of the logarithm of a trait from the median's
UNSEEN_DISTANCE = 1e4  # m behind, where cars that are not seen are put

Cars = Float[Any, "cars"]
States = Float[Any, "*times cars 4"]
Sides = Int[Any, "cars"]
TraitLogarithms = Float[Any, "cars 3"]


def seen_states(states: States) -> States:
    """Return the states, with cars that are not seen standing far behind."""
    return jnp.where(
        jnp.isfinite(states).all(axis=-1, keepdims=True),
        states,
        jnp.array([-UNSEEN_DISTANCE, -UNSEEN_DISTANCE, 0.0, 0.0]),
    )


def lane_centre(snapshot: Snapshots, side: int | Sides) -> Cars:
    """Return the centre of the lane that many lanes to the right of each car's lane, at
    most of the outermost one.
    """
    lane = lane_numbers(snapshot.lanes, seen_states(snapshot.past[-1])[:, 1])
    return snapshot.lanes[jnp.clip(lane + side, 0, len(snapshot.lanes) - 1)]


def lane_numbers(lanes: Float[Any, "lanes"], y: Cars) -> Sides:
    """Return the number of the lane whose centre is nearest to each lateral position."""
    return jnp.argmin(jnp.abs(y[:, None] - lanes), axis=-1)


def leader_of(
    snapshot: Snapshots, states: States, others: States, lane: Cars
) -> Leader:
    """Return the nearest of the others ahead of each car, in the lane around a lateral
    position for each.
    """
    not_itself = ~jnp.eye(len(states), dtype=bool)
    lengths = snapshot.sizes[:, 0]
    place, there = leaders(
        states[:, 0], lane, others, not_itself, snapshot.lane_width / 2
    )
    gap = others[place, 0] - states[:, 0] - (lengths + lengths[place]) / 2
    return Leader(jnp.where(there, gap, HELD_CONTROL.free_gap), others[place, 3], there)


def roll_out(
    drivers: Drivers,
    snapshot: Snapshots,
    logarithms: TraitLogarithms,
    side: Sides,
    around: States | None = None,
) -> Float[Any, "50 cars 4"]:
    """Let all cars of one snapshot drive for 5 s; return their states after each step.

    Args:
        drivers: the learned drivers.
        snapshot: the start, one of `Snapshots`.
        logarithms: of the cars' traits, see `shown_traits`.
        side: number of lanes to the right by which each car changes, -1, 0 or 1; a car
            that changes lanes follows the leader in its new lane.
        around: states of the others before each step, among which each car drives
            alone; by default, all cars drive together.
    """
    changes = side != 0
    wanted = lane_centre(snapshot, side)

    def factor(name: str) -> Cars:
        return jnp.where(changes, drivers.changing.get(name, 1.0), 1.0)

    weights = {name: weight * factor(name) for name, weight in drivers.weights.items()}
    usual = drivers.prior.traits(logarithms, snapshot.speed_limit)
    speeds = usual.desired_speed * factor("desired speed")
    headways = usual.headway * factor("typical headway")
    traits = RewardTraits(speeds, headways, usual.patience)

    @jax.checkpoint  # or else gradients over 5 s would exhaust the memory
    def go(now: States, others: States | None) -> tuple[States, States]:
        x, y, heading, speed = now.T
        leader = leader_of(
            snapshot,
            now,
            now if others is None else others,
            jnp.where(changes, wanted, y),
        )
        acceleration = held_acceleration(weights, traits, speed, leader)
        curvature = held_curvature(weights, y - wanted, heading, speed)
        faster = jnp.maximum(speed + acceleration * TIME_STEP, 0.0)
        distance = (speed + faster) / 2 * TIME_STEP
        ahead = x + distance * jnp.cos(heading)
        aside = y + distance * jnp.sin(heading)
        after = jnp.stack(
            [ahead, aside, heading + curvature * distance, faster], axis=-1
        )
        return after, after

    return jax.lax.scan(go, seen_states(snapshot.past[-1]), around, length=STEPS)[1]


def shown_traits(drivers: Drivers, snapshot: Snapshots) -> TraitLogarithms:
    """Return the means of the logarithms of traits, relative to the medians', given the
    past 3 s of one snapshot.

    For each full second of a car's past, an extended Kalman filter is updated with the
    car's mean acceleration, which `held_acceleration` in the recorded states predicts
    with the prior's noise. Surprises are clipped to 3 standard deviations.
    """
    prior = drivers.prior
    seen = jnp.isfinite(snapshot.past).all(axis=-1)
    past = seen_states(snapshot.past)
    speeds = past[..., 3]
    leader = jax.vmap(lambda states: leader_of(snapshot, states, states, states[:, 1]))(
        past
    )

    @jax.vmap
    @jax.value_and_grad
    def expected(logarithms: TraitLogarithms, speed: Cars, leader: Leader) -> Scalar:
        usual = prior.traits(logarithms, snapshot.speed_limit)
        return held_acceleration(drivers.weights, usual, speed, leader).mean()

    mean = jnp.zeros((past.shape[1], 3))
    covariance = jnp.tile(
        jnp.diag(jnp.asarray(prior.deviations) ** 2), (len(mean), 1, 1)
    )
    for first in range(0, PAST_STEPS, STEPS_PER_SECOND):
        then = slice(first, first + STEPS_PER_SECOND, STRIDE)
        last = first + STEPS_PER_SECOND
        gained = (speeds[last] - speeds[first]) / (STEPS_PER_SECOND * TIME_STEP)
        predicted, slope = expected(
            mean,
            speeds[then].T,
            Leader(*(jnp.asarray(part)[then].T for part in leader)),
        )
        along = jnp.einsum("cij,cj->ci", covariance, slope)
        variance = jnp.sum(slope * along, axis=1) + prior.noise**2
        reach = MAX_SURPRISE * jnp.sqrt(variance)
        gain = (
            jnp.where(seen[first : last + 1].all(axis=0), 1 / variance, 0.0)[:, None]
            * along
        )
        moved = mean + gain * jnp.clip(gained - predicted, -reach, reach)[:, None]
        mean = jnp.clip(moved, -MAX_DEVIATION, MAX_DEVIATION)
        covariance -= gain[:, :, None] * along[:, None]
    return mean
