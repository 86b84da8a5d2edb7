"""Compute the terminal value of plans: what they leave for the time after them.

Plans take only a few seconds. The terminal value has five terms:

* each lane to the right has a value, and a lane change has a cost;
* mandatory lane changes that remain cost more, the less room is left for them;
* a shortfall of the gap to a car ahead costs, see `ms_highway.road.stopping_room`;
* so does the speed that traffic then costs, see `ms_highway.road.cost_to_go`.

The urgency of mandatory lane changes follows from the present speed and room, and is
the same for all plans. The rest follows from each plan, mostly from its end.

Costs that another car causes are returned for each path of this car. They lower the
score of a plan. The choice of models does not use them, as ``responsive`` of
`ms_highway.road.score.Scores` leaves them out. A car with several paths is charged for
each of them, in full.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.perception.scene import SHAPE, PerPath, PerPlan, PlanLanes
from ms_highway.road.cost_to_go import cost_to_go
from ms_highway.road.plan_control import target_of
from ms_highway.road.proposals import Profiles
from ms_highway.road.simulation import SimulatedPlans
from ms_highway.road.stopping_room import gap_shortfall
from ms_highway.road.traffic import Situation, lane_of
from ms_highway.runtime.arrays import Numbers


@dataclass(frozen=True)
class LaneChangeRoom:
    """Set how much room mandatory lane changes need."""

    seconds: float = 2.0
    """Duration of a lane change [s]."""
    lowest_speed: float = 8.0
    """Lower bound of the speed with which the needed room is computed: a slower car
    speeds up before it changes lanes [m/s].
    """
    decay_length: float = 40.0
    """Spare room over which the cost of mandatory lane changes falls to 1 / e [m]."""


LANE_CHANGE_ROOM = LaneChangeRoom()


class TerminalValue(NamedTuple):
    """Terminal values of plans.

    Attributes:
        own_value: value of the lane that each plan goes to, less the cost-to-go of
            plans that no other car limits.
        costs_by_path: cost that each path of another car causes, at least 0.
        gap_shortfall: see `ms_highway.road.stopping_room.gap_shortfall` [m].
    """

    own_value: PerPlan
    costs_by_path: PerPath
    gap_shortfall: PerPath


def terminal_value(
    situation: Situation,
    simulated: SimulatedPlans,
    plans: Profiles,
) -> TerminalValue:
    """Return the terminal value of each plan: its own part, and the costs of others.

    Args:
        situation: what all plans share.
        simulated: the plans.
        plans: their profiles, in the same order.
    """
    weights = situation.weights
    s, d, _, _ = simulated.states[:, -1].T  # each [plans]

    # The share of the lane change that is done when a plan ends.
    lane_centre = lane_of(situation.scene.lanes, plans.lane, s)
    distance = jnp.abs(lane_centre - d)
    completion = jnp.clip(1 - distance / situation.planning.lane_width, 0.0, 1.0)
    completion = jnp.where(plans.lane == SHAPE.own_lane, 1.0, completion)
    lane_value = _lane_value(situation, plans.lane, completion)

    # The shortfall of gaps, charged to the cars ahead.
    steered_to = jax.vmap(target_of, (None, 0, 0))(situation, plans, s)
    shortfall = gap_shortfall(situation, simulated, steered_to)
    costs_by_path = weights.stopping * shortfall

    # The cost-to-go from the lane in which most of the robot is. It is charged to the
    # car that limits the speed, or else to the plan itself. Paths of one car that
    # coincide are tied, and each of them is charged in full.
    end_lane = jnp.where(completion > 0.5, plans.lane, SHAPE.own_lane)
    to_go = cost_to_go(situation, simulated, end_lane)
    cost = weights.terminal * to_go.speed_cost / situation.planning.desired_speed
    costs_by_path = costs_by_path + jnp.where(to_go.is_limiting, cost[:, None], 0.0)
    own_cost = jnp.where(to_go.is_limiting.any(axis=-1), 0.0, cost)
    return TerminalValue(lane_value - own_cost, costs_by_path, shortfall)


def _lane_value(
    situation: Situation,
    lanes: PlanLanes,
    completion: PerPlan,
) -> PerPlan:
    """Return the value of the lane that each plan goes to.

    The reward for lanes to the right and the cost of mandatory lane changes count as
    far as the lane change is done. The cost of the change itself counts in full.

    Args:
        situation: what all plans share.
        lanes: target lanes of the plans.
        completion: share of the lane change that is done when each plan ends.
    """
    weights = situation.weights
    right_value = weights.right * completion * (lanes - float(SHAPE.own_lane))
    change_cost = weights.change * (lanes != SHAPE.own_lane)

    # Interpolate the urgency between the own lane and the target lane.
    urgency = _urgency(situation)  # [lanes]
    own_urgency = urgency[SHAPE.own_lane]
    urgency_change = completion * (urgency[lanes] - own_urgency)
    goal_cost = weights.goal * (own_urgency + urgency_change)
    return right_value - change_cost - goal_cost


def _urgency(situation: Situation) -> Numbers:
    """Return the urgency of mandatory lane changes from each lane.

    It is ``changes exp(-spare_room / decay_length)``, from the number of lane changes
    that the goal asks for, and from the room that they leave over.
    """
    scene = situation.scene
    changes = jnp.abs(scene.changes)

    # The present speed and room, the same for all plans.
    present_speed = scene.robot[3]
    speed = jnp.maximum(present_speed, LANE_CHANGE_ROOM.lowest_speed)
    needed_room = changes * speed * LANE_CHANGE_ROOM.seconds
    spare_room = jnp.maximum(scene.room - needed_room, 0.0)
    return changes * jnp.exp(-spare_room / LANE_CHANGE_ROOM.decay_length)
