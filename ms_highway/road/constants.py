"""What plans on roads may do, want and cost."""

from dataclasses import dataclass, field

import jax
from jax import numpy as jnp

from ms_highway.perception.scene import Steps
from ms_highway.runtime.arrays import Scalar

MODELS = "naive", "idm", "tom"
"""Models that predict traffic, cheapest first: keep the velocity along the lane; follow by IDM, but keep the velocity
on ways that cross the robot's; answer the robot's plan optimally (theory of mind)."""

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
        grip: total acceleration at most, the radius of the friction circle [m/s^2].
        curvature: of the path at most [1/m].
        time_step: of plans [s].
        steps: of plans (static).
        cornering: share of the grip that bends may take: the rest is for errors of steering (constant).
        stopping: share of the grip that a stop may take: the rest is for steering (constant).
    """

    desired_speed: Scalar = 30.0
    grip: Scalar = 5.0
    curvature: Scalar = 0.2
    time_step: Scalar = 0.2
    steps: int = field(default=20, metadata={"static": True})
    cornering = 0.85
    stopping = 0.9

    @property
    def times(self) -> Steps:
        """Time after each step [s]."""
        return jnp.arange(1, self.steps + 1) * self.time_step


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadWeights:
    """What a plan is worth: weights, per second unless stated otherwise, and the constants of the score.

    Weights may change without compiling anew. Constants are attributes of the class. The values are those with which
    most episodes of highway-env's scenes succeed, by hand, unless a reason is given.

    Attributes:
        speed: of the share of the desired speed that is reached.
        terminal: of the share of it that is lost after the plan [for the whole plan].
        centre: of the squared distance to the centre of the lane [1/m^2].
        change: of leaving the lane, once [for the whole plan].
        right: of each lane further to the right [for the whole plan].
        goal: of each change of lane that is left to the goal, where the room for it is short [for the whole plan].
        acceleration: of squared acceleration [s^4/m^2].
        jerk: of squared jerk [s^6/m^2].
        imposed: of the squared braking that cars behind are made to do [s^4/m^2].
        near: of being nearer than `comfortable` to others, squared share.
        comfortable: distance between bodies [m].
        collision: of hitting somebody at once; less, the later [for the whole plan].
        blocking: of being in the way of a car that crosses, after a plan [for the whole plan].
        avoidable: share that counts of what can still be avoided by stopping before a crossing.
        off_road: of leaving the road, and of a lane that is not open [for the whole plan].
        stopping: of each metre that is missing to stop behind the car ahead [1/m, for the whole plan].

        unsound: cost of a broken constraint: more than plans earn or cost otherwise.
        leaving: speed of an impact that is as bad as to leave the road [m/s].
        margin: between bodies that counts as a collision: predictions err by this much in a step [m].
        wreck_margin: the same to what cannot move, which plans pass in steps of 0.2 s [m].
        fading: factor per step of what is expected later, as predictions get worse.
        soon: time up to which predicted collisions count, even if the plan could still stop [s].
        early: time by which cars that cross may come earlier or later [s].
        unsure: acceleration that others may have besides the predicted one [m/s^2].
        tolerated: braking of others that costs nothing: as drivers do when they come off the gas [m/s^2].
        begun: lateral offset from which a lane change has begun [m].
        off: increase of the distance off the road that counts as leaving it [m].
        decided: first step from which a plan must be able to stop before a crossing: the next plan starts there.
        corridor: half the width of the robot's way, which crossing cars have to leave [m].
        clearance: before and behind the robot, to those who cross [m].
        awaited: time; a crossing car that comes later does not count [s].
        passed: time by which the robot must have left a crossing before the next car arrives [s].

        least_headway: smallest time gap within a plan [s].
        room: to the car ahead, after a stop [m].
        reaction: time before the robot brakes [s].
        lead_braking: with which a car ahead may brake [m/s^2].
        beside: distance aside, beyond touching, up to which others are in the lane [m].
        disturbed: distance to a car that joins, up to which others may change lanes for it [m].
        change_seconds: time that a change of lane takes [s].
        change_speed: speed at which that is reckoned at least, as standing cars change lanes as they start [m/s].
        urgency_range: spare room over which the cost of changes that are left falls to 1 / e [m].

        horizon: seconds after a plan of which the loss of speed counts.
        blocked: cost of a second in the way of others: more than the loss of all speed [steps of speed].
        lane_change: cost of a change of lane after a plan [steps of speed].
        close_up_seconds, close_up_gap: time in which, and gap to which a car ahead is closed up to [s, m].
        room_ahead, room_behind: to others after a plan [m].
        headway_behind: the latter at most, at the desired speed: in jams, others follow more closely [s].
        comfort_braking: behind others after a plan [m/s^2].
        away: time before an oncoming car is there, by which the robot has left its lane [s].
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
    leaving = 10.0
    margin = 0.35
    wreck_margin = 0.6
    fading = 0.95
    soon = 1.6
    early = 0.08
    unsure = 6.0
    tolerated = 1.5
    begun = 0.5
    off = 0.1
    decided = 1
    corridor = 3.0
    clearance = 1.0
    awaited = 6.0
    passed = 0.5

    least_headway = 0.2
    room = 1.0
    reaction = 0.2
    lead_braking = 2.0
    beside = 0.2
    disturbed = 25.0
    change_seconds = 2.0
    change_speed = 8.0
    urgency_range = 40.0

    horizon = 8
    blocked = 30.0
    lane_change = 0.3
    close_up_seconds = 3.0
    close_up_gap = 5.0
    room_ahead = 1.0
    room_behind = 3.0
    headway_behind = 0.3
    comfort_braking = 2.5
    away = 1.0
