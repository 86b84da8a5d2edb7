"""Compute how much room the robot lacks to stop behind the cars ahead of a plan."""

from dataclasses import dataclass

from jax import numpy as jnp

from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import EachCar, EachFlag, Plans
from ms_highway.road.simulation import SimulatedPlans
from ms_highway.road.traffic import COSINES, STANDING_SPEED, Situation


@dataclass(frozen=True)
class StoppingRoom:
    """Set the gaps that plans keep to the cars ahead, so that the robot can stop.

    All values were set by hand so that most episodes of highway-env's scenes succeed.
    """

    least_headway: float = 0.2
    """Smallest time gap to the car ahead within a plan [s]."""
    stop_gap: float = 1.0
    """Gap to the car ahead once both stand [m]."""
    reaction_time: float = 0.2
    """Time before the robot brakes: the next plan comes a step later [s]."""
    lead_braking: float = 2.0
    """Deceleration that a car ahead may use [m/s^2]."""
    lateral_clearance: float = 0.2
    """Lateral distance between bodies up to which others are in the lane [m]."""
    merge_range: float = 25.0
    """Distance to a merging car up to which others may change lanes for it [m]."""


STOPPING_ROOM = StoppingRoom()


def missing_room(
    situation: Situation,
    simulated: SimulatedPlans,
    target: Plans,
) -> EachCar:
    """Return the distance that each plan lacks to each car ahead [m].

    It is the larger one of the distance that is missing to stop after the plan, and of
    what is missing to the least time gap within it.

    Args:
        situation: what all plans share.
        simulated: the plans.
        target: lateral position that each plan steers to [m].
    """
    after_plan = _missing_after(situation, simulated, target)
    return jnp.maximum(after_plan, _missing_within(situation, simulated))


def _missing_within(situation: Situation, simulated: SimulatedPlans) -> EachCar:
    """Return the largest distance that is missing to the least time gap within a plan.

    Ignore gap violations that exist at the start, and static obstacles: there is no gap
    to keep.
    """
    scene = situation.scene
    traffic = simulated.traffic
    s, d, _, speed = simulated.robot  # each [plans, 1, steps]

    # Which cars the robot follows in each step. The middle of the robot is half a
    # length ahead of its rear axle.
    distance = traffic.s - s - scene.size[0] / 2
    contact = scene.contact[:, 0]
    beside = scene.contact[:, 1] + STOPPING_ROOM.lateral_clearance
    follows = (
        (distance > 0)
        & (jnp.abs(traffic.d - d) < beside[:, None])
        & (traffic.cosine > COSINES.same_way)
        & scene.moving[:, None]
    )

    # The gap has to be at least headway * speed.
    missing = STOPPING_ROOM.least_headway * speed + contact[:, None] - distance
    missing = jnp.where(follows, jnp.maximum(missing, 0.0), 0.0)
    return jnp.maximum(missing.max(axis=-1) - missing[..., 0], 0.0)


def _missing_after(
    situation: Situation,
    simulated: SimulatedPlans,
    target: Plans,
) -> EachCar:
    """Return the distance that is missing to stop behind each car ahead after a plan.

    At the speed v behind a car of speed u, the robot needs the gap

        stop_gap + reaction_time v + max(v - u, 0)^2 / (2 b),

    where b is the robot's braking less that of the car ahead.
    """
    scene = situation.scene
    planning = situation.planning
    end = simulated.traffic.last  # fields [plans, traffic]
    s, d, _, speed = (field[..., -1] for field in simulated.robot)  # each [plans, 1]
    middle = s + scene.size[0] / 2

    # The strip of road that the robot passes while it steers to its target, wider for
    # cars that may change to the next lane.
    beside = scene.contact[:, 1] + STOPPING_ROOM.lateral_clearance
    may_change = jnp.where(
        _may_change_lanes(situation, simulated), planning.lane_width, 0.0
    )
    leftmost = jnp.minimum(target[:, None], d) - beside - may_change
    rightmost = jnp.maximum(target[:, None], d) + beside + may_change

    # Cars ahead in this strip that are slower than the robot. Those that cross it at
    # speed are not in the lane for long.
    in_strip = (end.s > middle) & (end.d > leftmost) & (end.d < rightmost)
    stays = (end.cosine > COSINES.not_crossing) | (end.speed < STANDING_SPEED)
    is_slower = end.forward_speed < speed
    counts = in_strip & scene.present & stays & is_slower

    # The gap that stopping takes, and what is missing to it.
    closing_speed = jnp.maximum(speed - end.forward_speed, 0.0)
    braking = planning.stopping * planning.grip - STOPPING_ROOM.lead_braking
    needed = (
        STOPPING_ROOM.stop_gap
        + STOPPING_ROOM.reaction_time * speed
        + closing_speed**2 / (2 * braking)
    )
    missing = needed - end.s + middle + scene.contact[:, 0]
    return jnp.where(counts, jnp.maximum(missing, 0.0), 0.0)


def _may_change_lanes(situation: Situation, simulated: SimulatedPlans) -> EachFlag:
    """Return which cars may change to the next lane at once, without looking.

    These are the cars that merge into the road, and those near them.
    """
    scene = situation.scene
    traffic = simulated.traffic
    end = traffic.last

    # Cars that are beside the road now, and go the robot's way in the end.
    first_d = traffic.d[..., 0]
    left_edge, right_edge = interpolate(scene.edges, traffic.s[..., 0])
    is_off_road = (first_d < left_edge) | (first_d > right_edge)
    merges = is_off_road & (end.cosine > COSINES.same_way) & scene.present

    distance = jnp.abs(end.s[:, :, None] - end.s[:, None])  # [plans, traffic, traffic]
    near = distance < STOPPING_ROOM.merge_range
    return (merges[:, None] & near).any(axis=-1)
