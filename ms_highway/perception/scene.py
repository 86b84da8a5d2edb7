"""A stretch of any road as arrays of fixed shapes: the robot's route, its lanes and edges, and the traffic on it.

Road coordinates are (s, d): s along a path, d to its right [m]. A state is ``(s, d, heading, speed)``, the heading
relative to the path. World coordinates are highway-env's: y points to the right of x.
"""

from dataclasses import dataclass
from typing import Any

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.geometry.curve import Curve, Knots
from ms_highway.runtime.arrays import Car, Numbers, Scalar, State

KNOTS, TRAFFIC_KNOTS = 96, 64
"""Number of knots of the robot's route, 20 m behind to 170 m ahead, and of the paths of others, to 106 m ahead."""

LANES = 3
"""Lanes that the robot can choose: left of its own, its own, right of it."""

TRAFFIC = 20
"""Number of paths of others that plans look at."""

Sizes = Float[Any, "*cars 2"]
Steps = Float[Any, "*shape steps"]
States = Float[Any, "*plans steps 4"]
Lane = Int[Any, "*plans"]
Plans = Float[Any, "plans"]
PlanFlags = Bool[Any, "plans"]
EachCar = Float[Any, "*plans traffic"]
EachFlag = Bool[Any, "*plans traffic"]
EachStep = Float[Any, "*plans traffic steps"]
Values = Float[Any, "lanes places speeds"]

World = Float[Any, "*shape 4 steps"]
"""x, y, heading and speed of cars after each step, in world coordinates."""

Traffic = Float[Any, "traffic"]
Flags = Bool[Any, "traffic"]
Places = Int[Any, "traffic"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadScene:
    """What the robot sees of a road.

    Attributes:
        route: smooth way along the lanes that the robot follows.
        lanes: lateral positions of the centres of `LANES` lanes at the knots of the route: left, own, right [m].
        open: where each of them may be driven on.
        edges: lateral positions of the left and the right edge of the road at the knots [m].
        changes: changes of lane to the right that the goal asks for from each lane, negative to the left.
        room: distance left for them [m]; infinite where the goal asks for none.
        robot: state of the middle of the robot's rear axle.
        size: length and width of the robot [m].
        applied: curvature and acceleration that the robot has applied last [1/m, m/s^2].
        paths: of others, one for each way that they may take, `TRAFFIC` of them.
        states: of others on these paths: their centres.
        sizes: length and width of others [m].
        present: which of the paths are in use.
        limits: speed limits of others [m/s].
        leaders: place of the car ahead of each other car on its path, -1 without one.
        gaps: distance of centres to that car [m].
        owners: number of the car that each path belongs to, the same as long as it is in sight; -1 where none does.
        moving: which of the others can move; obstacles and absent ones cannot.
        accelerations: of others since the last look, 0 of new ones [m/s^2].
    """

    route: Curve
    lanes: Knots
    open: Knots
    edges: Knots
    changes: Numbers
    room: Scalar
    robot: Car
    size: Sizes
    applied: Sizes
    paths: Curve
    states: State
    sizes: Sizes
    present: Flags
    limits: Traffic
    leaders: Places
    gaps: Traffic
    owners: Places
    moving: Flags
    accelerations: Traffic

    @property
    def askew(self) -> Sizes:
        """Angle of each of the others to its path that it keeps: its own if it cannot move, none if it drives."""
        return jnp.where(self.moving, 0.0, self.states[:, 2])[:, None]

    @property
    def reach(self) -> Sizes:
        """Distance of centres at which the robot and each other car touch, along and across [m]."""
        turned = jnp.abs(jnp.sin(self.askew)) * self.sizes[:, ::-1]
        return (self.size + jnp.abs(jnp.cos(self.askew)) * self.sizes + turned) / 2
