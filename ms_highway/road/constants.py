"""Limits, wishes and weights of plans on roads."""

from dataclasses import dataclass, field

import jax
from jax import numpy as jnp

from ms_highway.perception.scene import Steps
from ms_highway.runtime.arrays import Scalar

MODELS = "naive", "idm", "tom"
"""Models that predict traffic, cheapest first: keep the velocity along the lane; follow
by IDM, but keep the velocity on paths that cross the robot's; respond optimally to the
robot's plan (theory of mind).
"""

NAIVE, IDM, TOM = range(len(MODELS))
"""Numbers of these models."""

LANE = 4.0
"""Width of lanes [m]."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadPlanning:
    """Limits and wishes of a robot on a road.

    Attributes:
        desired_speed: [m/s].
        grip: largest total acceleration, the radius of the friction circle [m/s^2].
        curvature: largest curvature of the path [1/m].
        time_step: of plans [s].
        frame: duration of the frames of the simulation, in each of which the robot
            moves straight on [s].
        steps: number of steps of a plan (static).
        cornering: share of the grip that plans use in bends; the rest is for steering
            errors (constant).
        stopping: share of the grip that plans use to stop; the rest is for steering
            (constant).
    """

    desired_speed: Scalar = 30.0
    grip: Scalar = 5.0
    curvature: Scalar = 0.2
    time_step: Scalar = 0.2
    frame: Scalar = 1 / 15
    steps: int = field(default=20, metadata={"static": True})
    cornering = 0.85
    stopping = 0.9

    @property
    def lag(self) -> Scalar:
        """Time by which the mean heading of motion lags behind the mean heading of the
        car: half a frame [s].
        """
        return jnp.minimum(self.frame, self.time_step) / 2

    @property
    def times(self) -> Steps:
        """Time after each step [s]."""
        return jnp.arange(1, self.steps + 1) * self.time_step


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadWeights:
    """Weights and constants of the score of a plan.

    Weights count per second unless their unit says "per plan"; they may change without
    compiling anew. Constants are attributes of the class. The values were set by hand
    so that most episodes of highway-env's scenes succeed, unless a reason is given.

    Attributes:
        speed: weight of the share of the desired speed that the robot reaches.
        terminal: weight of the share of it that the robot loses after the plan [per
            plan].
        centre: weight of the squared distance to the centre of the lane [1/m^2].
        change: cost of a lane change [per plan].
        right: value of each lane further to the right [per plan].
        goal: cost of each lane change that the goal still asks for, where the room for
            it is short [per plan].
        acceleration: weight of squared acceleration [s^4/m^2].
        jerk: weight of squared jerk [s^6/m^2].
        imposed: weight of the squared braking that the robot imposes on cars behind it
            [s^4/m^2].
        near: weight of the squared share of `comfortable` by which a car is nearer than
            that.
        comfortable: distance between bodies below which nearness costs [m].
        collision: cost of an immediate collision; later collisions cost less [per
            plan].
        blocking: cost of standing in the way of a crossing car after the plan [per
            plan].
        avoidable: factor of costs that the robot can still avoid by stopping before a
            crossing.
        off_road: cost of leaving the road, or of a lane that is closed [per plan].
        stopping: cost of each metre that the robot lacks to stop behind the car ahead
            [1/m, per plan].

        unsound: cost of a broken constraint; it exceeds whatever else plans earn or
            cost.
        off_road_impact: speed of an impact that is as bad as leaving the road [m/s].
        margin: distance between bodies that counts as a collision: predictions err by
            this much in a step [m].
        wreck_margin: the same to obstacles, which plans pass in steps of 0.2 s [m].
        discount: factor per step by which expected costs shrink, as predictions get
            worse.
        certain_time: time up to which predicted collisions count even if the plan could
            still stop [s].
        arrival_error: time by which crossing cars may arrive earlier or later than
            predicted [s].
        acceleration_error: acceleration by which others may deviate from the prediction
            [m/s^2].
        tolerated_braking: braking of others that costs nothing, as when a driver lifts
            off the accelerator [m/s^2].
        lane_change_offset: lateral offset from which a lane change has begun [m].
        off_road_tolerance: increase of the distance off the road that counts as leaving
            it [m].
        replanned_step: first step from which a plan must be able to stop before a
            crossing; the next plan starts there.
        corridor: half the width of the robot's corridor, which crossing cars have to
            leave [m].
        clearance: distance before and behind the robot to crossing cars [m].
        crossing_horizon: time horizon for crossing cars; later ones do not count [s].
        crossing_time_gap: time between the robot's leaving a crossing and the arrival
            of the next car, at least [s].

        least_headway: smallest time gap within a plan [s].
        stop_gap: gap to the car ahead after a stop [m].
        reaction_time: time before the robot brakes [s].
        lead_braking: deceleration that a car ahead may use [m/s^2].
        lateral_clearance: lateral distance between bodies up to which others are in the
            lane [m].
        merge_range: distance to a merging car up to which others may change lanes for
            it [m].
        change_seconds: duration of a lane change [s].
        change_speed: lowest speed for which the room of a lane change is computed:
            standing cars start first [m/s].
        urgency_range: spare room over which the cost of remaining lane changes falls to
            1 / e [m].

        horizon: seconds after a plan in which the loss of speed counts.
        blocked_cost: cost of a second in the way of others; it exceeds the loss of all
            speed [steps of speed].
        lane_change: cost of a lane change after a plan [steps of speed].
        close_up_seconds, close_up_gap: time within which, and gap to which, the robot
            closes up to a car ahead [s, m].
        room_ahead, room_behind: gaps to others after a plan [m].
        headway_behind: upper bound of ``room_behind`` as a time gap at the desired
            speed: in jams, others follow more closely [s].
        comfort_braking: deceleration behind others after a plan [m/s^2].
        oncoming_time: time before an oncoming car arrives by which the robot has left
            its lane [s].
    """

    speed: Scalar = 1.0
    terminal: Scalar = 6.0
    centre: Scalar = 0.005
    change: Scalar = 0.1
    right: Scalar = 0.1
    goal: Scalar = 6.0
    acceleration: Scalar = 0.01
    jerk: Scalar = 0.002
    imposed: Scalar = 0.3
    near: Scalar = 8.0
    comfortable: Scalar = 1.0
    collision: Scalar = 100.0
    blocking: Scalar = 40.0
    avoidable: Scalar = 0.02
    off_road: Scalar = 200.0
    stopping: Scalar = 1.0

    unsound = 1e3
    off_road_impact = 10.0
    margin = 0.35
    wreck_margin = 0.6
    discount = 0.95
    certain_time = 1.6
    arrival_error = 0.08
    acceleration_error = 6.0
    tolerated_braking = 1.5
    lane_change_offset = 0.5
    off_road_tolerance = 0.1
    replanned_step = 1
    corridor = 3.0
    clearance = 1.0
    crossing_horizon = 6.0
    crossing_time_gap = 0.5

    least_headway = 0.2
    stop_gap = 1.0
    reaction_time = 0.2
    lead_braking = 2.0
    lateral_clearance = 0.2
    merge_range = 25.0
    change_seconds = 2.0
    change_speed = 8.0
    urgency_range = 40.0

    horizon = 8
    blocked_cost = 30.0
    lane_change = 0.3
    close_up_seconds = 3.0
    close_up_gap = 5.0
    room_ahead = 1.0
    room_behind = 3.0
    headway_behind = 0.3
    comfort_braking = 2.5
    oncoming_time = 1.0
