"""Relate the traffic to the robot's route.

Find positions on it, crossings, leading cars, obstacles and speed limits.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool

from ms_highway.game.car_following import FREE_GAP
from ms_highway.geometry.bodies import CORNERS, Sizes
from ms_highway.geometry.curve import (
    BEHIND,
    SPACING,
    Curve,
    Knots,
    Pose,
    interpolate,
    rotated,
)
from ms_highway.perception.scene import (
    SHAPE,
    Flags,
    PlanLanes,
    RoadScene,
    Steps,
    Traffic,
)
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.road_weights import RoadWeights
from ms_highway.road.swing import inward_shift_of, sharpest_bends
from ms_highway.runtime.arrays import Array, Flag, Numbers, Scalar, Vector

STANDING_SPEED = 1.0
"""Speed below which a car counts as standing [m/s]."""

PASSING_GAP = 0.4
"""Distance between bodies that pass each other [m]."""


@dataclass(frozen=True)
class PathCosines:
    """Say by the cosine of its path's angle to the robot's route how a car drives.

    Each bound allows for a path that bends within the lane: 0.85 is 32 degrees, and 0.5
    is 60 degrees.
    """

    shares_lane: float = 0.85
    """From here on, the car drives in the robot's lane; from minus this value on down,
    it comes towards the robot.
    """
    same_way: float = 0.8
    """From here on, the car goes the same way as the robot."""
    follows: float = 0.7
    """From here on, a car follows the robot ahead of it."""
    not_crossing: float = 0.5
    """From here on, the car is no crossing car."""


COSINES = PathCosines()


@dataclass(frozen=True)
class CrossingSettings:
    """Set where paths cross the robot's route, and where the robot waits for them."""

    corridor: float = 3.0
    """Half the width of the robot's corridor, which crossing cars have to leave [m]."""
    waiting_gap: float = 0.8
    """Distance between the waiting robot and crossing cars [m]."""
    passed_margin: float = 1.0
    """Distance behind the robot's rear axle from which on nobody crosses its path any
    more [m].
    """
    place_spacing: float = 0.5
    """Distance between the places on paths where crossings are looked for [m]. Knots of
    paths move with their cars, so that waiting lines at knots would jump.
    """

    @property
    def present_place(self) -> int:
        """Number of the place where a car is now."""
        return int(BEHIND / self.place_spacing)


CROSSING = CrossingSettings()


@dataclass(frozen=True)
class ObstacleSettings:
    """Set which obstacles the robot passes, and how much room it needs before them."""

    sight: float = 30.0
    """Distance ahead within which the robot passes obstacles [m]."""
    margin: float = 10.0
    """Length of route beyond the sight that obstacles are projected to [m]."""
    turning_room: float = 4.0
    """Room before an obstacle that the robot needs to turn round it [m]."""

    @property
    def knots(self) -> int:
        """Number of knots of the route in sight, without the next lap of a loop."""
        return int((BEHIND + self.sight + self.margin) / SPACING)


OBSTACLES = ObstacleSettings()


class RelativePaths(NamedTuple):
    """Paths of traffic in the coordinates of the robot's route.

    They are given at the knots of the paths.

    Attributes:
        s, d: position on the route [m].
        cosine: of the angle between the path and the route.
    """

    s: Knots
    d: Knots
    cosine: Knots

    def at(self, along: Traffic, across: Traffic) -> Pose:
        """Return where others are on the route, from where they are on their paths.

        Returns:
            s and d on the robot's route, and the cosine of the angle between the two.
        """
        s, d, cosine = (jax.vmap(interpolate)(field, along) for field in self)
        return s, d + across * cosine, cosine


class Crossings(NamedTuple):
    """Where paths of traffic cross the robot's route.

    Attributes:
        places: positions along the paths [m].
        s, d: of these places on the route [m]; d is far away where a path is nearly
            parallel to the route or lies behind the robot, and for oncoming vehicles.
        oncoming: which vehicles come towards the robot in its lane.
        line: position on the route where the front of the robot waits for crossing cars
            [m].
        begin, last: positions on the path where the crossing begins and ends [m]; far
            away without one.
    """

    places: Steps
    s: Knots
    d: Knots
    oncoming: Flags
    line: Traffic
    begin: Traffic
    last: Traffic

    @property
    def exist(self) -> Flags:
        """Which of the paths cross the route."""
        return self.begin < FREE_GAP


class Obstruction(NamedTuple):
    """The obstacles in the robot's lane, taken together.

    Attributes:
        exists: whether there are any.
        sides: lateral positions at which the robot passes them on the left and on the
            right [m].
        begin, end: positions on the route between which they lie [m].
    """

    exists: Flag
    sides: Vector
    begin: Scalar
    end: Scalar


class Situation(NamedTuple):
    """What all plans of a step share.

    Attributes:
        scene: the road.
        planning: limits, and the desired speed.
        weights: of the score.
        paths: of the traffic, relative to the route.
        crossings: of these paths and the route.
        leading: which vehicles drive ahead of the robot in its lane.
        inward_shift: how far inside its lane the rear axle has to be at the knots of
            the route, see `ms_highway.road.swing.inward_shift_of` [m].
        speed_caps: highest speeds at the knots of the route [m/s].
        obstruction: of the robot's lane.
        contact: see `RoadScene.contact`; computed once, since many steps use it [m].
    """

    scene: RoadScene
    planning: RoadPlanning
    weights: RoadWeights
    paths: RelativePaths
    crossings: Crossings
    leading: Flags
    inward_shift: Knots
    speed_caps: Knots
    obstruction: Obstruction
    contact: Sizes


def situation_of(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadWeights,
) -> Situation:
    """Compute what all plans of a step share."""
    route_s, route_d, turn = scene.route.project(
        scene.paths.x, scene.paths.y, scene.paths.heading
    )
    paths = RelativePaths(route_s, route_d, jnp.cos(turn))

    s, d, cosine = paths.at(scene.states[:, 0], scene.states[:, 1])
    leading = (
        (s > scene.robot[0])
        & (cosine > COSINES.not_crossing)
        & (jnp.abs(d - scene.robot[1]) < scene.size[1])
    )

    inward_shift = inward_shift_of(scene)
    return Situation(
        scene,
        planning,
        weights,
        paths,
        _crossings(scene, paths),
        leading,
        inward_shift,
        _speed_caps(scene, planning, inward_shift),
        _obstruction(scene, weights),
        scene.contact,
    )


def _crossings(scene: RoadScene, paths: RelativePaths) -> Crossings:
    """Find where paths of traffic cross the robot's route.

    Vehicles in the robot's lane, and those that merge behind the robot, are not
    crossing traffic even if paths part later: one of them follows the other. Nothing
    crosses behind the robot.
    """
    # Places on each path, arrays [traffic, places]. The absolute value of d is
    # interpolated, since the sign of d may change between knots.
    path_length = SPACING * paths.s.shape[-1]
    places = jnp.arange(-BEHIND, path_length - BEHIND, CROSSING.place_spacing)
    at_places = jax.vmap(interpolate, (0, None))
    s = at_places(paths.s, places)
    d = at_places(paths.d, places)
    distance = at_places(jnp.abs(paths.d), places)
    cosine = at_places(paths.cosine, places)
    in_corridor = distance < CROSSING.corridor

    # Places where other paths are in the robot's corridor, at an angle.
    shares_lane = _shares_lane(scene, places, s, cosine, in_corridor)
    at_angle = (
        (s > scene.robot[0] - CROSSING.passed_margin)
        & (cosine < COSINES.shares_lane)
        & ~shares_lane[:, None]
    )
    crosses = in_corridor & at_angle

    # The robot waits before the first stretch of the path that is in the corridor.
    first_s = lowest(s[:, 1:], crosses[:, 1:] & crosses[:, :-1])
    line = first_s - scene.sizes[:, 1] / 2 - CROSSING.waiting_gap
    oncoming = _oncoming(scene, s, cosine, in_corridor)
    counts = at_angle & ~oncoming[:, None]
    crossing_d = jnp.where(counts, jnp.sign(d) * distance, FREE_GAP)
    begin = lowest(places, crosses)
    last = highest(places, crosses)
    return Crossings(places, s, crossing_d, oncoming, line, begin, last)


def _shares_lane(
    scene: RoadScene,
    places: Numbers,
    s: Numbers,
    cosine: Numbers,
    in_corridor: Bool[Array, "traffic places"],
) -> Flags:
    """Return which vehicles drive in the robot's lane, or merge into it behind it.

    Args:
        scene: the road.
        places: positions along the paths [m].
        s: of these places on the route, [traffic, places] [m].
        cosine: of the angle between path and route there.
        in_corridor: whether the path is in the robot's corridor there.
    """
    along_route = in_corridor & (cosine > COSINES.shares_lane)
    merges_behind = along_route & (s < scene.robot[0]) & (places >= 0)
    return along_route[:, CROSSING.present_place] | merges_behind.any(axis=-1)


def _oncoming(
    scene: RoadScene,
    s: Numbers,
    cosine: Numbers,
    in_corridor: Bool[Array, "traffic places"],
) -> Flags:
    """Return which vehicles come towards the robot in its lane.

    For the arguments see `_shares_lane`.
    """
    now = CROSSING.present_place
    return (
        in_corridor[:, now]
        & (cosine[:, now] < -COSINES.shares_lane)
        & (s[:, now] > scene.robot[0])
        & scene.moving
    )


def lane_of(values: Knots, lanes: PlanLanes, s: Numbers) -> Numbers:
    """Interpolate values of lanes for plans that go to one lane each.

    Each lane has its values at the knots of the route.
    """
    return jax.vmap(lambda lane, s: interpolate(values[lane], s))(lanes, s)


def _speed_caps(scene: RoadScene, planning: RoadPlanning, inward_shift: Knots) -> Knots:
    """Return the highest speed at each knot of the route [m/s].

    From there, gentle braking suffices for all bends ahead. A bend of curvature k
    allows the speed ``v_k^2 = cornering grip / k``. At a distance x before it, braking
    by b allows ``v^2 = v_k^2 + 2 b x``.
    """
    bends = jnp.maximum(sharpest_bends(scene, inward_shift), 1e-4)
    squared_speed = jnp.minimum(
        planning.cornering * planning.grip / bends, planning.desired_speed**2
    )
    gained = 2 * planning.bend_braking * SPACING * jnp.arange(len(bends))
    lowest_ahead = jax.lax.cummin(squared_speed + gained, reverse=True) - gained
    return jnp.sqrt(jnp.maximum(lowest_ahead, 1.0))


def _obstruction(scene: RoadScene, weights: RoadWeights) -> Obstruction:
    """Find the obstacles in the robot's lane.

    The corners of bodies are compared in the coordinates of the robot's route. Bodies
    that slide, ``v' = -v``, occupy both their present and their final position.
    """
    s, d = _corners(scene)
    rear = jnp.min(s, axis=(1, 2))
    front = jnp.max(s, axis=(1, 2))
    left = jnp.min(d, axis=(1, 2))
    right = jnp.max(d, axis=(1, 2))

    # Obstacles that leave too little of the robot's lane.
    needed = scene.size[1] + 2 * weights.comfortable
    lane_centre = interpolate(scene.lanes[SHAPE.own_lane], rear)
    is_near = (
        scene.present
        & ~scene.moving
        & (front > scene.robot[0])
        & (rear < scene.robot[0] + OBSTACLES.sight)
    )
    obstructs = (
        is_near & (left < lane_centre + needed / 2) & (right > lane_centre - needed / 2)
    )

    pass_left = lowest(left, obstructs) - needed / 2
    pass_right = highest(right, obstructs) + needed / 2
    return Obstruction(
        obstructs.any(),
        jnp.stack([pass_left, pass_right]),
        lowest(rear, obstructs),
        highest(front, obstructs),
    )


def _corners(scene: RoadScene) -> tuple[Numbers, Numbers]:
    """Return s and d of the corners of others on the route [m], [traffic, 2, corners].

    They are those of the present and of the final position of a body that slides.
    """
    # Present and final positions of the bodies, [traffic, 2].
    along, across, heading, speed = jnp.asarray(scene.states).T[..., None]
    slid = speed * jnp.array([0.0, 1.0])
    x, y, path_heading = jax.vmap(Curve.place)(
        scene.paths, along + slid * jnp.cos(heading), across + slid * jnp.sin(heading)
    )

    # The corners relative to these positions, in world coordinates.
    ahead, sideways = jnp.moveaxis(scene.sizes[:, None, None] / 2 * CORNERS, -1, 0)
    path_heading = path_heading[..., None]
    corner_x, corner_y = rotated(
        ahead, sideways, -path_heading - scene.body_angle[..., None]
    )

    # The corners on the route, as far as it is in sight.
    in_sight = jax.tree.map(lambda knots: knots[: OBSTACLES.knots], scene.route)
    s, d, _ = in_sight.project(
        x[..., None] + corner_x, y[..., None] + corner_y, path_heading
    )
    return s, d


def lowest(values: Numbers, where: Bool[Array, "..."]) -> Numbers:
    """Return the lowest of the values that count in the last axis.

    It is `FREE_GAP` where none counts.
    """
    return jnp.where(where, values, FREE_GAP).min(axis=-1)


def highest(values: Numbers, where: Bool[Array, "..."]) -> Numbers:
    """Return the highest of the values that count in the last axis.

    It is minus `FREE_GAP` where none counts.
    """
    return jnp.where(where, values, -FREE_GAP).max(axis=-1)
