"""Value the ends of plans: the lane that they reach, the room to stop, and the speed
that traffic then allows.
"""

from functools import reduce
from typing import Any

import jax
from jax import numpy as jnp
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Float

from ms_highway.game.car_following import FREE_GAP
from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import EachCar, EachFlag, PlanLanes, Plans
from ms_highway.road.constants import LANE
from ms_highway.road.proposals import Profiles
from ms_highway.road.simulation import DrivenPlans, target_of
from ms_highway.road.traffic import (
    CROSSING,
    SAME_WAY,
    STANDING_SPEED,
    Situation,
    lane_of,
)
from ms_highway.runtime.arrays import Numbers, Scalar

Values = Float[Any, "lanes places speeds"]

LANES_BESIDE = 2  # lanes on each side of the robot's lane in the table of values
PLACES, SPEEDS = 144, 13  # in the table
SLOWER, FASTER = 2, 1  # largest changes of speed in a second, in steps of speed


def terminal_value(
    now: Situation, driven: DrivenPlans, plans: Profiles
) -> tuple[Plans, EachCar, EachCar]:
    """Return the value of the time after plans.

    Returns:
        The value of the lane that each plan reaches, including lost speed for which no
        other car is responsible; the cost of each of the others, for missing room to
        stop and for the speed that it limits; and the distance that is missing to stop
        behind each of them [m].
    """
    lanes, weights, (s, d, *_) = plans.lane, now.weights, driven.states[:, -1].T
    aside = jnp.abs(lane_of(now.scene.lanes, lanes, s) - d)
    share = jnp.where(
        lanes == 1, 1.0, jnp.clip(1 - aside / LANE, 0.0, 1.0)
    )  # of the lane change that is done
    urgent = urgency(now)
    own = (
        weights.right * share * (lanes - 1.0)
        - weights.change * (lanes != 1)
        - weights.goal * (urgent[1] + share * (urgent[lanes] - urgent[1]))
    )
    missing = missing_room(
        now, driven, jax.vmap(target_of, (None, 0, 0))(now, plans, s)
    )
    slower, charged = speed_lost(now, driven, jnp.where(share > 0.5, lanes, 1))
    lost = weights.terminal * slower / now.planning.desired_speed
    others = weights.stopping * missing + jnp.where(charged, lost[:, None], 0.0)
    return own - jnp.where(charged.any(axis=-1), 0.0, lost), others, missing


def urgency(now: Situation) -> Numbers:
    """Return the number of lane changes that the goal asks for from each of three
    lanes, discounted by spare room.
    """
    scene = now.scene
    weights = now.weights
    left = jnp.abs(now.scene.changes)
    needed = (
        left
        * jnp.maximum(scene.robot[3], weights.change_speed)
        * weights.change_seconds
    )
    return left * jnp.exp(
        -jnp.maximum(scene.room - needed, 0.0) / weights.urgency_range
    )


def missing_room(now: Situation, driven: DrivenPlans, target: Plans) -> EachCar:
    """Return the distance that is missing to stop behind each car ahead after a plan,
    or to the least gap within it.

    Cars that merge into the road, and those near them, may change to the next lane at
    once, without looking. Ignore gap violations that exist at the start, and static
    obstacles: there is no gap to keep.

    Args:
        now: the situation.
        driven: the plans.
        target: lateral positions that the plans steer to [m].
    """
    scene, planning, weights, (s, d, _, speed) = (
        now.scene,
        now.planning,
        now.weights,
        driven.robot,
    )
    reach = scene.reach[:, 0]
    apart = scene.reach[:, 1] + weights.lateral_clearance
    gap = driven.s - s - scene.size[0] / 2
    led = (
        (gap > 0)
        & (jnp.abs(driven.d - d) < apart[:, None])
        & (driven.cosine > SAME_WAY)
        & scene.moving[:, None]
    )
    close = jnp.where(
        led, jnp.maximum(weights.least_headway * speed + reach[:, None] - gap, 0.0), 0.0
    )

    end, (s, d, speed) = driven.end, (field[..., -1] for field in (s, d, speed))
    left, right = interpolate(scene.edges, driven.s[..., 0])
    joins = (
        ((driven.d[..., 0] < left) | (driven.d[..., 0] > right))
        & (end.cosine > SAME_WAY)
        & scene.present
    )
    near = jnp.abs(end.s[:, :, None] - end.s[:, None]) < weights.merge_range
    beside = jnp.where((joins[:, None] & near).any(axis=-1), LANE, 0.0)
    middle = s + scene.size[0] / 2
    low = jnp.minimum(target[:, None], d) - apart - beside
    high = jnp.maximum(target[:, None], d) + apart + beside
    front = (end.s > middle) & (end.d > low) & (end.d < high) & scene.present
    onward = end.speeds * end.cosine
    counts = (
        front
        & ((end.cosine > CROSSING) | (end.speeds < STANDING_SPEED))
        & (onward < speed)
    )
    closing = jnp.maximum(speed - onward, 0.0)
    braking = planning.stopping * planning.grip - weights.lead_braking
    needed = (
        weights.stop_gap + weights.reaction_time * speed + closing**2 / (2 * braking)
    )
    missing = jnp.where(counts, jnp.maximum(needed - end.s + middle + reach, 0.0), 0.0)
    return jnp.maximum(missing, jnp.maximum(close.max(axis=-1) - close[..., 0], 0.0))


def speed_lost(
    now: Situation, driven: DrivenPlans, lanes: PlanLanes
) -> tuple[Plans, EachFlag]:
    """Return the mean loss of speed after each plan [m/s], and which of the others
    limits the speed first.

    All cars go on as points in their lanes, the others at their median speed over all
    plans. The robot drives optimally, by dynamic programming over lanes, places and
    speeds.

    Args:
        now: the situation.
        driven: the plans.
        lanes: in which the plans end, 0 to 2.
    """
    scene = now.scene
    weights = now.weights
    fastest = jnp.asarray(now.planning.desired_speed, float)
    s = driven.states[:, -1, 0] + scene.size[0] / 2
    speed = driven.states[:, -1, 3]
    step = fastest / (SPEEDS - 1)
    place = jnp.clip(s / step, 0.0, PLACES - 1.01)
    pace = jnp.clip(speed / step, 0.0, SPEEDS - 1.01)
    lost = -map_coordinates(
        _values(now, driven, step), [lanes + LANES_BESIDE - 1, place, pace], order=1
    )
    there, onward, inside = _others_after(
        now, driven, lane_of(scene.lanes, lanes, s)[:, None]
    )
    gap = there - s[:, None]
    closable = jnp.maximum(gap - scene.reach[:, 0] - weights.close_up_gap, 0.0)
    allowed = jnp.where(
        inside[:, 0] & (gap > 0), onward + closable / weights.close_up_seconds, FREE_GAP
    )
    first = (allowed == allowed.min(axis=-1, keepdims=True)) & (allowed < fastest)
    return lost * step / weights.horizon, first


def _others_after(
    now: Situation, driven: DrivenPlans, centres: Plans
) -> tuple[EachCar, EachCar, EachFlag]:
    """Return positions [m] and speeds [m/s] of others along the route after each plan,
    and in which lanes they are.
    """
    end = driven.end
    along = (
        (jnp.abs(end.cosine) > CROSSING) | (end.speeds < STANDING_SPEED)
    ) & now.scene.present
    inside = jnp.abs(end.d[:, None] - centres[..., None]) < LANE / 2 + 0.5
    return end.s, end.speeds * end.cosine, inside & along[:, None]


def _values(now: Situation, driven: DrivenPlans, step: Scalar) -> Values:
    """Return minus the loss of speed still to come, for each lane, place and speed
    after a plan [steps of speed].

    Places are as far apart as a step of speed leads in a second, so that the robot
    moves from place to place.
    """
    scene = now.scene
    weights = now.weights
    fastest = now.planning.desired_speed
    places = step * jnp.arange(PLACES)
    speeds = step * jnp.arange(SPEEDS)
    centres = LANE * jnp.arange(-LANES_BESIDE, LANES_BESIDE + 1.0)
    left, right = interpolate(scene.edges, places)
    there = (centres[:, None] > left + LANE / 4) & (centres[:, None] < right - LANE / 4)
    there = there.at[LANES_BESIDE].set(True)
    traffic = _others_after(now, driven, jnp.tile(centres, (len(driven.s), 1)))
    s, onward, inside = (jnp.median(field, axis=0) for field in traffic)
    reach = scene.reach[:, 0]
    seconds = jnp.arange(weights.horizon + 1)
    ahead = (s + onward * seconds[:, None])[:, None, None] - places[
        :, None
    ]  # [seconds, 1, places, traffic]
    room_behind = jnp.minimum(weights.room_behind, weights.headway_behind * fastest)
    ahead = jnp.where(
        (inside > 0.5)[:, None] & (ahead > -reach - room_behind),
        ahead - reach,
        FREE_GAP,
    )
    free = ahead.min(axis=-1, keepdims=True)
    onward = jnp.where(ahead == free, onward, FREE_GAP).min(
        axis=-1, keepdims=True
    )  # of the next car
    closing = jnp.maximum(speeds - jnp.maximum(onward, 0.0), 0.0)
    coming = weights.oncoming_time * jnp.maximum(-onward, 0.0)
    needed = (
        weights.room_ahead
        + weights.reaction_time * speeds
        + coming
        + closing**2 / (2 * weights.comfort_braking)
    )
    loss = jnp.maximum(
        jnp.minimum(interpolate(now.caps, places), fastest)[:, None] / step
        - jnp.arange(SPEEDS),
        0.0,
    )
    hindered = jnp.where(
        (free > needed) & there[..., None], 0.0, weights.blocked_cost
    )  # [seconds, lanes, places, speeds]

    def back(value: Values, after: tuple[Values, Values]) -> tuple[Values, None]:
        """Return the values a second earlier: the best change of speed, then the best
        change to a free lane.
        """
        value = jnp.pad(
            value - after[1] - loss, ((0, 0), (0, SPEEDS), (0, 0)), mode="edge"
        )
        value = jnp.stack(
            [value[:, speed : speed + PLACES, speed] for speed in range(SPEEDS)],
            axis=-1,
        )
        value = jnp.pad(
            value, ((0, 0), (0, 0), (SLOWER, FASTER)), constant_values=-jnp.inf
        )
        value = reduce(
            jnp.maximum,
            (
                value[..., change : change + SPEEDS]
                for change in range(SLOWER + FASTER + 1)
            ),
        )
        aside = jnp.pad(
            value - after[0] - weights.lane_change,
            ((1, 1), (0, 0), (0, 0)),
            constant_values=-FREE_GAP,
        )
        return jnp.maximum(value, jnp.maximum(aside[:-2], aside[2:])), None

    return jax.lax.scan(
        back, jnp.zeros(hindered.shape[1:]), (hindered[:-1], hindered[1:]), reverse=True
    )[0]
