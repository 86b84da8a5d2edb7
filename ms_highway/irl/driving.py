"""Let recorded drivers drive on together, each by the traits that it has shown."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

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
    """Return the centre of the lane some lanes to the right of each car's lane.

    Beyond the outermost lane, it is that of the outermost one.
    """
    y = seen_states(snapshot.past[-1])[:, 1]
    lane = lane_indices(snapshot.lanes, y)
    outermost = len(snapshot.lanes) - 1
    reached = jnp.clip(lane + side, 0, outermost)
    return snapshot.lanes[reached]


def lane_indices(lanes: Float[Array, "lanes"], y: Cars) -> Sides:
    """Return the index of the lane whose centre is nearest to each position."""
    distances = jnp.abs(y[:, None] - lanes)  # [cars, lanes]
    return jnp.argmin(distances, axis=-1)


def leader_of(
    snapshot: Snapshots,
    states: States,
    others: States,
    lane: Cars,
) -> Leader:
    """Return the nearest of the others ahead of each car, in a lane for each.

    Args:
        snapshot: with the sizes of cars and lanes.
        states: of the cars.
        others: states of the same cars, among which leaders are looked for.
        lane: lateral position around which each car has its lane [m].
    """
    not_itself = ~jnp.eye(len(states), dtype=bool)
    lengths = snapshot.sizes[:, 0]
    x = states[:, 0]
    reach = snapshot.lane_width / 2
    index, is_there = leaders(x, lane, others, not_itself, reach)

    # The gap between bumpers.
    distance = others[index, 0] - x
    gap = distance - (lengths + lengths[index]) / 2
    gap = jnp.where(is_there, gap, HELD_CONTROL.free_gap)
    return Leader(gap, others[index, 3], is_there)


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
        neighbours = now if others is None else others
        leader = leader_of(snapshot, now, neighbours, lane)
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
    """Infer drivers' traits from the past 3 s of one snapshot.

    Returns the means of the traits' logarithms, relative to the medians'. For each full
    second of a car's past, an extended Kalman filter is updated with the car's mean
    acceleration, which `held_acceleration` in the recorded states predicts with the
    prior's noise. Surprises are clipped to 3 standard deviations.
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
        """Return the mean acceleration of a car with some traits, and its gradient."""
        usual = prior.traits(logarithms, snapshot.speed_limit)
        acceleration = held_acceleration(drivers.weights, usual, speed, leader)
        return acceleration.mean()

    # The prior: the medians' traits.
    mean = jnp.zeros((past.shape[1], 3))
    variances = jnp.asarray(prior.deviations) ** 2
    covariance = jnp.tile(jnp.diag(variances), (len(mean), 1, 1))  # [cars, 3, 3]
    belief = TraitBelief(mean, covariance)

    second = SNAPSHOT.steps_per_second
    for first in range(0, SNAPSHOT.past_steps, second):
        last = first + second

        # Measured and predicted: h(x) with the gradient H at the present mean x.
        measured = (speeds[last] - speeds[first]) / (second * TIME_STEP)
        times = slice(first, last, TRAIT_FILTER.stride)
        leader_then = Leader(*(jnp.asarray(part)[times].T for part in leader))
        predicted, gradient = expected(belief.mean, speeds[times].T, leader_then)
        throughout = is_seen[first : last + 1].all(axis=0)
        belief = _updated(
            belief, measured - predicted, gradient, prior.noise, throughout
        )
    return belief.mean


class TraitBelief(NamedTuple):
    """A normal distribution of the logarithms of every car's traits.

    Attributes:
        mean: x.
        covariance: P.
    """

    mean: TraitLogarithms
    covariance: Float[Array, "cars 3 3"]


def _updated(
    belief: TraitBelief,
    surprise: Cars,
    gradient: TraitLogarithms,
    noise: Scalar,
    is_measured: Bool[Array, "cars"],
) -> TraitBelief:
    """Update a belief by one measurement of each car, as a Kalman filter does.

    Args:
        belief: before.
        surprise: measured less predicted value.
        gradient: H, of the predicted value in the mean.
        noise: standard deviation of measurements.
        is_measured: which cars have a measurement.
    """
    # The gain K = P H / (H P H + noise^2), 0 without a measurement.
    covariance_gradient = jnp.einsum("cij,cj->ci", belief.covariance, gradient)
    variance = jnp.sum(gradient * covariance_gradient, axis=1) + noise**2
    precision = jnp.where(is_measured, 1 / variance, 0.0)
    gain = precision[:, None] * covariance_gradient

    # x += K surprise, P -= K (P H)^T.
    largest = TRAIT_FILTER.max_surprise * jnp.sqrt(variance)
    clipped = jnp.clip(surprise, -largest, largest)
    most = TRAIT_FILTER.max_deviation
    mean = jnp.clip(belief.mean + gain * clipped[:, None], -most, most)
    reduction = gain[:, :, None] * covariance_gradient[:, None]
    return TraitBelief(mean, belief.covariance - reduction)
