"""Value the time after plans, from the place and the speed at which they end.

A plan takes a few seconds. What it is worth also depends on what the robot can do
afterwards. Three things are valued:

* the lane that the plan reaches: lanes to the right are worth more, and each lane
  change that the goal still asks for costs, the more the shorter the room for it is;
* the room to stop behind cars ahead, see `ms_highway.road.stopping_room`;
* the speed that traffic then allows, see `ms_highway.road.lost_speed`.

Costs for which another car is responsible are charged to this car, so that the choice
of models knows whose prediction matters.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.perception.scene import EachCar, PlanLanes, Plans
from ms_highway.road.lost_speed import speed_lost
from ms_highway.road.plan_control import target_of
from ms_highway.road.proposals import Profiles
from ms_highway.road.simulation import SimulatedPlans
from ms_highway.road.stopping_room import missing_room
from ms_highway.road.traffic import Situation, lane_of
from ms_highway.runtime.arrays import Numbers


@dataclass(frozen=True)
class LaneChangeRoom:
    """Set how much room the lane changes to a goal need."""

    seconds: float = 2.0
    """Duration of a lane change [s]."""
    lowest_speed: float = 8.0
    """Lowest speed for which the room is computed: standing cars start first [m/s]."""
    urgency_range: float = 40.0
    """Spare room over which the cost of remaining lane changes falls to 1 / e [m]."""


LANE_CHANGE_ROOM = LaneChangeRoom()


class TerminalValue(NamedTuple):
    """Value of the time after plans.

    Attributes:
        own: value of the lane that each plan reaches, including lost speed for which no
            other car is responsible.
        others: cost of each of the others, for missing room to stop and for the speed
            that it limits.
        missing_room: distance that is missing to stop behind each of them [m].
    """

    own: Plans
    others: EachCar
    missing_room: EachCar


def terminal_value(
    situation: Situation,
    simulated: SimulatedPlans,
    plans: Profiles,
) -> TerminalValue:
    """Return the value of the time after plans."""
    weights = situation.weights
    s, d, _, _ = simulated.states[:, -1].T  # each [plans]

    # The lane that each plan reaches: the target lane if most of the lane change is
    # done.
    target_centre = lane_of(situation.scene.lanes, plans.lane, s)
    distance = jnp.abs(target_centre - d)
    done = jnp.clip(1 - distance / situation.planning.lane_width, 0.0, 1.0)
    done = jnp.where(plans.lane == 1, 1.0, done)
    lane_reached = jnp.where(done > 0.5, plans.lane, 1)
    value = _lane_value(situation, plans.lane, done)

    # The room to stop, charged to the cars ahead.
    target = jax.vmap(target_of, (None, 0, 0))(situation, plans, s)
    missing = missing_room(situation, simulated, target)
    charged = weights.stopping * missing

    # The lost speed, charged to the cars that limit it, or else to the plan itself.
    lost = speed_lost(situation, simulated, lane_reached)
    cost = weights.terminal * lost.speed / situation.planning.desired_speed
    charged = charged + jnp.where(lost.is_limiting, cost[:, None], 0.0)
    own_cost = jnp.where(lost.is_limiting.any(axis=-1), 0.0, cost)
    return TerminalValue(value - own_cost, charged, missing)


def _lane_value(situation: Situation, lanes: PlanLanes, done: Plans) -> Plans:
    """Return the value of the lane that each plan reaches.

    Args:
        situation: what all plans share.
        lanes: target lanes of the plans.
        done: share of the lane change that each plan completes.
    """
    weights = situation.weights
    to_the_right = weights.right * done * (lanes - 1.0)
    change = weights.change * (lanes != 1)

    # A plan pays for the lane changes that remain from where it is between its lanes.
    urgency = _urgency(situation)
    present_urgency = urgency[1]
    gained = done * (urgency[lanes] - present_urgency)
    goal = weights.goal * (present_urgency + gained)
    return to_the_right - change - goal


def _urgency(situation: Situation) -> Numbers:
    """Return the number of lane changes that the goal asks for from each lane.

    Spare room discounts it.
    """
    scene = situation.scene
    changes = jnp.abs(scene.changes)
    speed = jnp.maximum(scene.robot[3], LANE_CHANGE_ROOM.lowest_speed)
    needed_room = changes * speed * LANE_CHANGE_ROOM.seconds
    spare_room = jnp.maximum(scene.room - needed_room, 0.0)
    return changes * jnp.exp(-spare_room / LANE_CHANGE_ROOM.urgency_range)
