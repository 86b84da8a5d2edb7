"""Record the weights of the score of a plan on a road."""

from dataclasses import dataclass

import jax

from ms_highway.runtime.arrays import Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadWeights:
    """Weigh what a plan earns and costs.

    Weights count per second unless their unit says "per plan"; they may change without
    compiling anew. The values were set by hand so that most episodes of highway-env's
    scenes succeed.
    """

    speed: Scalar = 1.0
    """Weight of the share of the desired speed that the robot reaches."""
    terminal: Scalar = 6.0
    """Weight of the cost-to-go per second, as a share of the desired speed [per plan].
    See `ms_highway.road.cost_to_go`.
    """
    centre: Scalar = 0.005
    """Weight of the squared distance to the centre of the lane [1/m^2]."""
    change: Scalar = 0.1
    """Cost of a lane change [per plan]."""
    right: Scalar = 0.1
    """Value of each lane further to the right [per plan]."""
    goal: Scalar = 6.0
    """Cost of each remaining mandatory lane change at full urgency [per plan]."""
    acceleration: Scalar = 0.01
    """Weight of squared acceleration [s^4/m^2]."""
    jerk: Scalar = 0.002
    """Weight of squared jerk [s^6/m^2]."""
    imposed: Scalar = 0.3
    """Weight of the squared braking that the robot imposes on others [s^4/m^2]."""
    near: Scalar = 8.0
    """Weight of the squared share of `comfortable` that the distance to a car lacks."""
    comfortable: Scalar = 1.0
    """Distance between bodies below which nearness costs [m]."""
    collision: Scalar = 100.0
    """Cost of an immediate collision; later collisions cost less [per plan]."""
    blocking: Scalar = 40.0
    """Cost of standing in the way of a crossing car after the plan [per plan]."""
    avoidable: Scalar = 0.02
    """Factor of costs that the robot can still avoid by stopping before a crossing."""
    off_road: Scalar = 200.0
    """Cost of leaving the road, or of a lane that is closed [per plan]."""
    stopping: Scalar = 1.0
    """Cost of each metre by which the gap to a car ahead is too short [1/m, per plan].
    """
