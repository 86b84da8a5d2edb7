"""Compute by how much the gaps of plans to the cars ahead are too short."""

from dataclasses import dataclass

from jax import numpy as jnp

from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import FlagPerPath, PerPath, PerPlan
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
    """Assumed deceleration of a car ahead [m/s^2]."""
    lateral_clearance: float = 0.2
    """Lateral distance between bodies up to which others are in the lane [m]."""
    merge_range: float = 25.0
    """Distance to a merging car up to which others may change lanes for it [m]."""


STOPPING_ROOM = StoppingRoom()


def gap_shortfall(
    situation: Situation,
    simulated: SimulatedPlans,
    steered_to: PerPlan,
) -> PerPath:
    """Return by how much the gap to each car ahead falls short, at least 0 [m].

    It is the larger one of two shortfalls: to the stopping gap after the plan, and to
    the least time gap within the plan.

    Args:
        situation: what all plans share.
        simulated: the plans.
        steered_to: lateral position that each plan steers to [m].
    """
    after_plan = _shortfall_after(situation, simulated, steered_to)
    return jnp.maximum(after_plan, _shortfall_within(situation, simulated))


def _shortfall_within(situation: Situation, simulated: SimulatedPlans) -> PerPath:
    """Return the largest shortfall to the least time gap within a plan.

    It counts as far as it exceeds the shortfall after the first step, which plans
    hardly change. The robot keeps no time gap to static obstacles.
    """
    scene = situation.scene
    traffic = simulated.traffic
    s, d, _, speed = simulated.robot  # each [plans, 1, steps]

    # Which cars the robot follows in each step, [plans, traffic, steps]. The middle of
    # the robot is half a length ahead of its rear axle.
    distance = traffic.s - s - scene.size[0] / 2
    contact_length = situation.contact[:, 0]
    clearance = situation.contact[:, 1] + STOPPING_ROOM.lateral_clearance
    follows = (
        (distance > 0)
        & (jnp.abs(traffic.d - d) < clearance[:, None])
        & (traffic.cosine > COSINES.same_way)
        & scene.moving[:, None]
    )

    # The gap has to be at least headway * speed.
    needed = STOPPING_ROOM.least_headway * speed + contact_length[:, None]
    shortfall = needed - distance
    shortfall = jnp.where(follows, jnp.maximum(shortfall, 0.0), 0.0)
    largest = shortfall.max(axis=-1)
    after_first_step = shortfall[..., 0]
    return jnp.maximum(largest - after_first_step, 0.0)


def _shortfall_after(
    situation: Situation,
    simulated: SimulatedPlans,
    steered_to: PerPlan,
) -> PerPath:
    """Return the shortfall to the stopping gap behind each slower car after a plan.

    At the speed v behind a car of speed u < v, the robot needs the gap

        stop_gap + reaction_time v + (v - u)^2 / (2 (b_robot - b_lead)).

    After the reaction time, the speeds become equal over the last term if the robot
    brakes by b_robot and the car ahead by b_lead. This is conservative behind a car
    that stands. No gap is required behind a car that is not slower.
    """
    scene = situation.scene
    planning = situation.planning
    end = simulated.traffic.last  # fields [plans, traffic]
    s, d, _, speed = (field[..., -1] for field in simulated.robot)  # each [plans, 1]
    middle = s + scene.size[0] / 2

    # The strip of road that the robot passes while it steers to its target, wider for
    # cars that may change to the next lane.
    clearance = situation.contact[:, 1] + STOPPING_ROOM.lateral_clearance
    may_change_lanes = _may_change_lanes(situation, simulated)
    lane_change = jnp.where(may_change_lanes, planning.lane_width, 0.0)
    leftmost = jnp.minimum(steered_to[:, None], d) - clearance - lane_change
    rightmost = jnp.maximum(steered_to[:, None], d) + clearance + lane_change

    # Slower cars ahead in this strip. Those that cross it at speed are not in the lane
    # for long; oncoming cars count in `ms_highway.road.cost_to_go`.
    in_strip = (end.s > middle) & (end.d > leftmost) & (end.d < rightmost)
    stays = (end.cosine > COSINES.not_crossing) | (end.speed < STANDING_SPEED)
    is_slower = end.forward_speed < speed
    counts = in_strip & scene.present & stays & is_slower

    # The stopping gap, and the shortfall to it. Cars that are not slower drop out.
    closing_speed = jnp.maximum(speed - end.forward_speed, 0.0)
    braking = planning.stopping * planning.grip - STOPPING_ROOM.lead_braking
    needed = (
        STOPPING_ROOM.stop_gap
        + STOPPING_ROOM.reaction_time * speed
        + closing_speed**2 / (2 * braking)
    )
    contact_length = situation.contact[:, 0]
    shortfall = needed - end.s + middle + contact_length
    return jnp.where(counts, jnp.maximum(shortfall, 0.0), 0.0)


def _may_change_lanes(situation: Situation, simulated: SimulatedPlans) -> FlagPerPath:
    """Return which cars may change lanes abruptly.

    These are the cars that merge into the road, and those near them, which make room.
    """
    scene = situation.scene
    traffic = simulated.traffic
    end = traffic.last

    # Cars that are beside the road now, and go the robot's way in the end.
    first_s = traffic.s[..., 0]
    first_d = traffic.d[..., 0]
    left_edge, right_edge = interpolate(scene.edges, first_s)
    is_off_road = (first_d < left_edge) | (first_d > right_edge)
    merges = is_off_road & (end.cosine > COSINES.same_way) & scene.present

    distance = jnp.abs(end.s[:, :, None] - end.s[:, None])  # [plans, traffic, traffic]
    near = distance < STOPPING_ROOM.merge_range
    return (merges[:, None] & near).any(axis=-1)
