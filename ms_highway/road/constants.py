"""What plans on roads may do, want and cost."""

from dataclasses import dataclass, field

import jax
from jax import numpy as jnp

from ms_highway.road.arrays import Steps
from ms_highway.runtime.arrays import Scalar

MODELS = "naive", "idm", "tom"
"""Models that predict traffic, cheapest first: keep the velocity along the lane; follow by IDM, but keep the velocity
on ways that cross the robot's; answer the robot's plan optimally (theory of mind)."""

NAIVE, IDM, TOM = range(len(MODELS))
"""Numbers of these models."""

LANE = 4.0
"""Width of lanes [m]."""

CORNERING, STOPPING = 0.85, 0.9
"""Shares of the grip that bends, and a stop, may take."""


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
    """

    desired_speed: Scalar = 30.0
    grip: Scalar = 5.0
    curvature: Scalar = 0.2
    time_step: Scalar = 0.2
    steps: int = field(default=20, metadata={"static": True})

    @property
    def times(self) -> Steps:
        """Time after each step [s]."""
        return jnp.arange(1, self.steps + 1) * self.time_step


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadWeights:
    """What a plan is worth, per second unless stated otherwise.

    Attributes:
        speed: of the share of the desired speed that is reached.
        prospect: of the share that the car ahead allows after the plan [for the whole plan].
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
    """

    speed: Scalar = 1.0
    prospect: Scalar = 6.0
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
