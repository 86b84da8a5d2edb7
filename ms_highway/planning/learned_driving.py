"""Drive like recorded drivers on a straight road, all cars together, each by the traits
that it has shown.

The best control that is held over the horizon has a closed form, `held_acceleration`
and `held_curvature`. The reward's features of traffic, of the lane and of comfort are
quadratic in a held acceleration and a held curvature, if a leader keeps its speed,
headings are small, and the attention to the leader is constant. So the best control is
a quotient of two sums over the steps. The risk of collisions, the braking of followers
and the edges of the road are left out, as they matter little while driving in a lane.
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.features import ATTENTION_GAP, HEADING_SHARE, STANDSTILL_GAP
from ms_highway.game.learned_drivers import Drivers, RewardTraits
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT, TIME_STEP
from ms_highway.game.scene import Leader, leaders
from ms_highway.geometry.curve import namespace
from ms_highway.runtime.arrays import Scalar

AnyCars = Float[Any, "*cars"]

UNIT = PAPER_UNIT  # m
TURN_SCALE = (
    1 / SPEED_LIMIT
)  # 1/m, of the planner's scaled curvature, see `ms_highway.game.scenario`
MAX_BRAKING, MAX_ACCELERATION, MAX_CURVATURE = 8.0, 4.0, 0.02  # m/s^2, m/s^2, 1/m
TIMES = TIME_STEP * np.arange(1, 6)  # s, of the steps over which a control is held


def held_acceleration(
    weights: Mapping[str, Any], traits: RewardTraits, speed: AnyCars, leader: Leader
) -> AnyCars:
    """Return the best acceleration to hold over `TIMES`, from -8 to 4 m/s^2.

    With the speed ``v_k = v + a t_k`` and the gap ``g_k = g + (v_leader - v) t_k - a
    t_k^2 / 2`` it maximises, with the attention w to the leader and the desired speed
    s::

        sum_k -speed ((v_k - s) / s)^2 - w headway ((g_k - 2 m - headway v_k) / U)^2
              - w closing_speed ((v_k - v_leader) / s)^2 - patience comfort (a / (U / s^2))^2 / 2

    Args:
        weights: of the reward, by name, at any common scale.
        traits: of the drivers.
        speed: [m/s].
        leader: of each.
    """
    xp = namespace(traits.desired_speed, speed, leader.gap)
    wish = xp.maximum(traits.desired_speed, 1.0)
    attention = xp.where(
        leader.there, xp.exp(-xp.maximum(leader.gap, 0.0) / (ATTENTION_GAP * UNIT)), 0.0
    )
    closing = leader.speed - speed
    slope = 0.0 * speed  # a float, also for whole speeds
    bend = len(TIMES) * weights["comfort_acceleration"] * traits.patience / UNIT**2
    for time in TIMES:
        lack = (
            leader.gap + closing * time - STANDSTILL_GAP * UNIT - traits.headway * speed
        )
        change = time**2 / 2 + traits.headway * time  # of the lack, per acceleration
        slope += 2 * weights["speed"] * (wish - speed) * time / wish**2
        slope += 2 * attention * weights["headway"] * lack * change / UNIT**2
        slope += 2 * attention * weights["closing_speed"] * closing * time / wish**2
        bend += (
            2
            * (weights["speed"] + attention * weights["closing_speed"])
            * time**2
            / wish**2
        )
        bend += 2 * attention * weights["headway"] * change**2 / UNIT**2
    return xp.clip(slope / bend, -MAX_BRAKING, MAX_ACCELERATION)


def held_curvature(
    weights: Mapping[str, Any], offset: AnyCars, heading: AnyCars, speed: AnyCars
) -> AnyCars:
    """Return the best curvature to hold over `TIMES`, at most 0.02 1/m to each side.

    With the lateral position ``y_k = offset + v heading t_k + v^2 c t_k^2 / 2`` and the
    heading ``h_k = heading + v c t_k`` it maximises ``sum_k -lane_alignment (y_k / U)^2
    - (direction + 0.01 lane_alignment) h_k^2 / 2 - comfort (c U 0.6)^2 / 2``.

    Args:
        weights: of the reward, by name.
        offset: from the centre of the wanted lane, to the right [m].
        heading: relative to the lane [rad].
        speed: [m/s].
    """
    xp = namespace(offset, speed)
    straight = weights["direction"] + HEADING_SHARE * weights["lane_alignment"]
    slope = 0.0 * speed  # a float, also for whole speeds
    bend = xp.full_like(speed, len(TIMES) * weights["comfort_steering"] / TURN_SCALE**2)
    for time in TIMES:
        aside = (speed * time) ** 2 / 2
        turned = speed * time
        slope -= (
            2
            * weights["lane_alignment"]
            * (offset + speed * time * heading)
            * aside
            / UNIT**2
        )
        slope -= straight * heading * turned
        bend += (
            2 * weights["lane_alignment"] * aside**2 / UNIT**2 + straight * turned**2
        )
    return xp.clip(slope / bend, -MAX_CURVATURE, MAX_CURVATURE)


# Driving, with the traits that a driver has shown

PAST_STEPS = 30
"""Steps of 0.1 s before a moment, from which the traits of drivers are inferred."""

STEPS = 50
"""Steps of 0.1 s after a moment, in which drivers drive."""

STEPS_PER_SECOND = 10
"""Steps of a second."""

FREE_GAP = 60.0
"""Distance to the leader if none is seen [m]."""

STRIDE = (
    2  # steps between the past times at which plans are compared with recorded driving
)
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


def lane_centre(snapshot: Any, side: int | Sides) -> Cars:
    """Return the centre of the lane that many lanes to the right of each car's lane, at
    most of the outermost one.
    """
    lane = lane_numbers(snapshot.lanes, seen_states(snapshot.past[-1])[:, 1])
    return snapshot.lanes[jnp.clip(lane + side, 0, len(snapshot.lanes) - 1)]


def lane_numbers(lanes: Float[Any, "lanes"], y: Cars) -> Sides:
    """Return the number of the lane whose centre is nearest to each lateral position."""
    return jnp.argmin(jnp.abs(y[:, None] - lanes), axis=-1)


def leader_of(snapshot: Any, states: States, others: States, lane: Cars) -> Leader:
    """Return the nearest of the others ahead of each car, in the lane around a lateral
    position for each.
    """
    not_itself = ~jnp.eye(len(states), dtype=bool)
    lengths = snapshot.sizes[:, 0]
    place, there = leaders(
        states[:, 0], lane, others, not_itself, snapshot.lane_width / 2
    )
    gap = others[place, 0] - states[:, 0] - (lengths + lengths[place]) / 2
    return Leader(jnp.where(there, gap, FREE_GAP), others[place, 3], there)


def roll_out(
    drivers: Drivers,
    snapshot: Any,
    logarithms: TraitLogarithms,
    side: Sides,
    around: States | None = None,
) -> Float[Any, "50 cars 4"]:
    """Let all cars of one snapshot drive for 5 s; return their states after each step.

    Args:
        drivers: the learned drivers.
        snapshot: the start, one of `ms_highway.irl.snapshots.Snapshots`.
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


def shown_traits(drivers: Drivers, snapshot: Any) -> TraitLogarithms:
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
            mean, speeds[then].T, Leader(*(part[then].T for part in leader))
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
