"""Describe a stretch of any road by arrays of fixed shapes.

They hold the robot's route, its lanes and edges, and the traffic on it. Road
coordinates are (s, d): s along a path, d to its right [m]. A state is ``(s, d, heading,
speed)``, the heading relative to the path. World coordinates are highway-env's: y
points to the right of x.
"""

from dataclasses import dataclass

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.geometry.bodies import Sizes
from ms_highway.geometry.curve import Curve, Knots
from ms_highway.runtime.arrays import Array, Car, Numbers, Scalar, State


@dataclass(frozen=True)
class SceneShape:
    """Set the shapes of a scene's arrays.

    They are the same for all roads, so that plans are compiled once.
    """

    route_knots: int = 96
    """Number of knots of the robot's route: 20 m behind to 170 m ahead."""
    lanes: int = 3
    """Number of lanes that the robot can choose: left, own and right, in this order."""
    own_lane: int = 1
    """Index of the robot's present lane among these lanes."""
    paths: int = 20
    """Number of paths of others."""
    path_knots: int = 64
    """Number of knots of the path of another car: 20 m behind to 106 m ahead."""


SHAPE = SceneShape()

Steps = Float[Array, "*shape steps"]
States = Float[Array, "*plans steps 4"]

PerPlan = Float[Array, "*plans"]
PlanFlags = Bool[Array, "*plans"]
PlanLanes = Int[Array, "*plans"]
"""Index of a lane for each plan, see `SceneShape.own_lane`."""

# The axis "traffic" counts paths. A car that may go several ways has several of them.
PerPath = Float[Array, "*plans traffic"]
FlagPerPath = Bool[Array, "*plans traffic"]
PerPathAndStep = Float[Array, "*plans traffic steps"]

World = Float[Array, "... 4 steps"]
"""x, y, heading and speed of cars after each step, in world coordinates."""

Traffic = Float[Array, "traffic"]
Flags = Bool[Array, "traffic"]
Places = Int[Array, "traffic"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadScene:
    """What the robot observes of a road.

    The traffic is described path by path: `SceneShape.paths` paths, several for a car
    that may go several ways.

    Attributes:
        route: smooth curve along the lanes that the robot follows.
        lanes: lateral positions of the centres of three lanes at the knots of the
            route: left, own, right [m].
        open: where the robot may drive on each of these lanes.
        edges: lateral positions of the left and the right edge of the road at the knots
            [m].
        changes: lane changes to the right that the goal asks for from each lane,
            negative to the left.
        room: distance left for these changes [m]; infinite where the goal asks for
            none.
        robot: state of the middle of the robot's rear axle.
        size: length and width of the robot [m].
        applied: last curvature and acceleration of the robot [1/m, m/s^2].
        paths: of others.
        states: of the centres of others on these paths.
        sizes: length and width of others [m].
        limits: speed limits of others [m/s].
        leaders: index of the path of the car ahead on each path, -1 without one.
        gaps: distance between the centres of each car and the car ahead [m].
        owners: number of the car that each path belongs to, constant while the car is
            in sight; -1 for unused paths.
        moving: which of the others can move; obstacles and unused paths cannot.
        accelerations: of others since the last look, 0 for new ones [m/s^2].
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
    limits: Traffic
    leaders: Places
    gaps: Traffic
    owners: Places
    moving: Flags
    accelerations: Traffic

    @property
    def present(self) -> Flags:
        """Which of the paths are in use."""
        return self.owners >= 0

    @property
    def body_angle(self) -> Float[Array, "traffic 1"]:
        """Constant part of the angle of each of the others to its path.

        It is 0 for cars that drive.
        """
        return jnp.where(self.moving, 0.0, self.states[:, 2])[:, None]

    @property
    def contact(self) -> Sizes:
        """Distance of centres at which the robot and each of the others touch [m].

        Longitudinal and lateral, [traffic, 2].
        """
        # The extent of a turned body along and across its path.
        by_sine = jnp.abs(jnp.sin(self.body_angle)) * self.sizes[:, ::-1]
        by_cosine = jnp.abs(jnp.cos(self.body_angle)) * self.sizes
        return (self.size + by_cosine + by_sine) / 2
