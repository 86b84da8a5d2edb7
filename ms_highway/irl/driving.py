"""Let recorded drivers drive on together, each by the traits that it has shown."""

from dataclasses import dataclass

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.data.learned_drivers import Drivers, RewardTraits
from ms_highway.game.scenario import TIME_STEP
from ms_highway.game.scene import Leader, leaders
from ms_highway.irl.snapshots import SNAPSHOT, Snapshots
from ms_highway.planning.learned_driving import (
    HELD_CONTROL,
    held_acceleration,
    held_curvature,
)
from ms_highway.runtime.arrays import Array, Scalar

Cars = Float[Array, "cars"]
States = Float[Array, "*times cars 4"]
Sides = Int[Array, "cars"]
TraitLogarithms = Float[Array, "cars 3"]


@dataclass(frozen=True)
class TraitFilter:
    """Set how traits are inferred from a driver's past."""

    stride: int = 2
    """Steps between the past times at which plans are compared with recordings."""
    max_surprise: float = 3.0
    """Standard deviations to which surprises are clipped."""
    max_deviation: float = 1.5
    """Largest deviation of the logarithm of a trait from the median's."""


TRAIT_FILTER = TraitFilter()


def seen_states(states: States) -> States:
    """Return the states, with cars that are not seen standing far behind."""
    distance = 1e4  # m
    is_seen = jnp.isfinite(states).all(axis=-1, keepdims=True)
    far_behind = jnp.array([-distance, -distance, 0.0, 0.0])
    return jnp.where(is_seen, states, far_behind)


def lane_centre(snapshot: Snapshots, side: int | Sides) -> Cars:
    """Return the centre of the lane that many lanes to the right of each car's lane, at
    most of the outermost one.
    """
    lane = lane_numbers(snapshot.lanes, seen_states(snapshot.past[-1])[:, 1])
    return snapshot.lanes[jnp.clip(lane + side, 0, len(snapshot.lanes) - 1)]


def lane_numbers(lanes: Float[Array, "lanes"], y: Cars) -> Sides:
    """Return the number of the lane whose centre is nearest to each position."""
    return jnp.argmin(jnp.abs(y[:, None] - lanes), axis=-1)


def leader_of(
    snapshot: Snapshots,
    states: States,
    others: States,
    lane: Cars,
) -> Leader:
    """Return the nearest of the others ahead of each car, in the lane around a lateral
    position for each.
    """
    not_itself = ~jnp.eye(len(states), dtype=bool)
    lengths = snapshot.sizes[:, 0]
    number, is_there = leaders(
        states[:, 0], lane, others, not_itself, snapshot.lane_width / 2
    )
    gap = others[number, 0] - states[:, 0] - (lengths + lengths[number]) / 2
    gap = jnp.where(is_there, gap, HELD_CONTROL.free_gap)
    return Leader(gap, others[number, 3], is_there)


def roll_out(
    drivers: Drivers,
    snapshot: Snapshots,
    logarithms: TraitLogarithms,
    side: Sides,
    around: States | None = None,
) -> Float[Array, "50 cars 4"]:
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
    target_lane = lane_centre(snapshot, side)

    def factor(name: str) -> Cars:
        """Return the factor of a weight or trait for cars that change lanes."""
        return jnp.where(changes, drivers.changing.get(name, 1.0), 1.0)

    # The reward of each car.
    weights = {name: weight * factor(name) for name, weight in drivers.weights.items()}
    usual = drivers.prior.traits(logarithms, snapshot.speed_limit)
    desired_speed = usual.desired_speed * factor("desired speed")
    headway = usual.headway * factor("typical headway")
    traits = RewardTraits(desired_speed, headway, usual.patience)

    @jax.checkpoint  # or else gradients over 5 s would exhaust the memory
    def drive(now: States, others: States | None) -> tuple[States, States]:
        """Return the states after a step, twice."""
        x, y, heading, speed = now.T
        lane = jnp.where(changes, target_lane, y)
        leader = leader_of(snapshot, now, now if others is None else others, lane)
        acceleration = held_acceleration(weights, traits, speed, leader)
        curvature = held_curvature(weights, y - target_lane, heading, speed)

        # v' = v + a dt, d = (v + v') dt / 2, along the heading before the step.
        speed_after = jnp.maximum(speed + acceleration * TIME_STEP, 0.0)
        distance = (speed + speed_after) / 2 * TIME_STEP
        x_after = x + distance * jnp.cos(heading)
        y_after = y + distance * jnp.sin(heading)
        heading_after = heading + curvature * distance
        after = jnp.stack([x_after, y_after, heading_after, speed_after], axis=-1)
        return after, after

    start = seen_states(snapshot.past[-1])
    _, states = jax.lax.scan(drive, start, around, length=SNAPSHOT.future_steps)
    return states


def shown_traits(drivers: Drivers, snapshot: Snapshots) -> TraitLogarithms:
    """Return the means of the logarithms of traits, relative to the medians', given the
    past 3 s of one snapshot.

    For each full second of a car's past, an extended Kalman filter is updated with the
    car's mean acceleration, which `held_acceleration` in the recorded states predicts
    with the prior's noise. Surprises are clipped to 3 standard deviations.
    """
    prior = drivers.prior
    is_seen = jnp.isfinite(snapshot.past).all(axis=-1)  # [times, cars]
    past = seen_states(snapshot.past)
    speeds = past[..., 3]

    def leader_at(states: States) -> Leader:
        return leader_of(snapshot, states, states, states[:, 1])

    leader = jax.vmap(leader_at)(past)

    @jax.vmap
    @jax.value_and_grad
    def expected(logarithms: Float[Array, "3"], speed: Cars, leader: Leader) -> Scalar:
        """Return the mean acceleration of a car with some traits, and its slopes."""
        usual = prior.traits(logarithms, snapshot.speed_limit)
        return held_acceleration(drivers.weights, usual, speed, leader).mean()

    mean = jnp.zeros((past.shape[1], 3))
    variances = jnp.asarray(prior.deviations) ** 2
    covariance = jnp.tile(jnp.diag(variances), (len(mean), 1, 1))  # [cars, 3, 3]
    second = SNAPSHOT.steps_per_second
    for first in range(0, SNAPSHOT.past_steps, second):
        last = first + second

        # Measured and predicted: h(x) with the slope H at the present mean x.
        measured = (speeds[last] - speeds[first]) / (second * TIME_STEP)
        times = slice(first, last, TRAIT_FILTER.stride)
        leader_then = Leader(*(jnp.asarray(part)[times].T for part in leader))
        predicted, slope = expected(mean, speeds[times].T, leader_then)

        # The gain K = P H / (H P H + noise^2), 0 for cars that were not always seen.
        covariance_slope = jnp.einsum("cij,cj->ci", covariance, slope)
        variance = jnp.sum(slope * covariance_slope, axis=1) + prior.noise**2
        throughout = is_seen[first : last + 1].all(axis=0)
        precision = jnp.where(throughout, 1 / variance, 0.0)
        gain = precision[:, None] * covariance_slope

        # x += K (measured - predicted), P -= K (P H)^T.
        largest = TRAIT_FILTER.max_surprise * jnp.sqrt(variance)
        surprise = jnp.clip(measured - predicted, -largest, largest)
        most = TRAIT_FILTER.max_deviation
        mean = jnp.clip(mean + gain * surprise[:, None], -most, most)
        covariance -= gain[:, :, None] * covariance_slope[:, None]
    return mean
