"""Record the parameters of a robot that plans on a road."""

from dataclasses import dataclass, field
from typing import ClassVar

import jax
from jax import numpy as jnp

from ms_highway.perception.scene import Steps
from ms_highway.runtime.arrays import Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadPlanning:
    """Set the limits and the desired speed of plans on a road.

    Fields may change without compiling anew, except `steps`; the rest is constant.
    """

    desired_speed: Scalar = 30.0
    """Speed on a free and straight road [m/s]."""
    grip: Scalar = 5.0
    """Largest total acceleration, the radius of the friction circle [m/s^2]."""
    curvature: Scalar = 0.2
    """Largest curvature of the path [1/m]."""
    time_step: Scalar = 0.2
    """Duration of a step of a plan [s]."""
    frame: Scalar = 1 / 15
    """Duration of the frames of the simulation, in each of which the robot moves
    straight on [s].
    """
    steps: int = field(default=20, metadata={"static": True})
    """Number of steps of a plan (static)."""

    cornering: ClassVar[float] = 0.85
    """Share of the grip that plans use in bends; the rest is for steering errors."""
    stopping: ClassVar[float] = 0.9
    """Share of the grip that plans use to stop; the rest is for steering."""
    bend_braking: ClassVar[float] = 2.5
    """Gentle deceleration before bends [m/s^2]."""
    lane_width: ClassVar[float] = 4.0
    """Width of all lanes in terminal values, best responses and the room to stop [m].

    It is that of highway-env's lanes.
    """

    @property
    def lag(self) -> Scalar:
        """Half a frame [s].

        The mean heading of motion lags behind that of the car by this time.
        """
        return jnp.minimum(self.frame, self.time_step) / 2

    @property
    def times(self) -> Steps:
        """Time after each step [s]."""
        return jnp.arange(1, self.steps + 1) * self.time_step
