"""Relate the traffic to the robot's route: positions on it, crossings, leading cars,
obstacles and speed limits.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.car_following import FREE_GAP
from ms_highway.geometry.bodies import CORNERS
from ms_highway.geometry.curve import (
    BEHIND,
    SPACING,
    Curve,
    Knots,
    Pose,
    interpolate,
    rotated,
)
from ms_highway.perception.scene import Flags, PlanLanes, RoadScene, Steps, Traffic
from ms_highway.road.constants import RoadPlanning, RoadWeights
from ms_highway.road.swing import inside_of, sharpest_bends
from ms_highway.runtime.arrays import Flag, Numbers, Scalar, Vector

STANDING_SPEED = 1.0
"""Speed below which a car counts as standing [m/s]."""

ROOM = 0.4
WAITING = 0.8
"""Distance between bodies that pass each other, and between the waiting robot and
crossing cars [m].
"""

SHARING = 0.85
SAME_WAY = 0.8
CROSSING = 0.5
"""Cosines of the angle between a car's path and the robot's route from which the car
shares the lane, goes the same way, and is no crossing car.
"""

# m behind the robot's rear axle, from which on nobody crosses its path any more
PASSED_MARGIN = 1.0
BEND_BRAKING = 2.5  # m/s^2, before bends
OBSTACLE_SIGHT = 30.0  # m ahead within which the robot passes obstacles
KNOTS_IN_SIGHT = int(
    (BEHIND + OBSTACLE_SIGHT + 10.0) / SPACING
)  # of the route, but not of the next lap of a loop
# m between places on crossing paths: knots move with cars, so waiting lines at knots
# would jump
STRIDE = 0.5


class Ways(NamedTuple):
    """Paths of traffic in the coordinates of the robot's route, at the knots of the
    paths.

    Attributes:
        s, d: position on the route [m].
        cosine: of the angle between the path and the route.
    """

    s: Knots
    d: Knots
    cosine: Knots

    def at(self, along: Traffic, across: Traffic) -> Pose:
        """Return s and d on the robot's route of others on their paths, and the cosine
        of the angle between the two.
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
        planning: limits and wishes.
        weights: of the score.
        ways: paths of the traffic, relative to the route.
        crossings: of these paths and the route.
        leading: which vehicles drive ahead of the robot in its lane.
        inside: how far inside its lane the rear axle has to be at the knots of the
            route, see `inside_of`.
        caps: highest speeds at the knots of the route, see `speed_caps`.
        obstruction: of the robot's lane.
    """

    scene: RoadScene
    planning: RoadPlanning
    weights: RoadWeights
    ways: Ways
    crossings: Crossings
    leading: Flags
    inside: Knots
    caps: Knots
    obstruction: Obstruction


def situation_of(
    scene: RoadScene, planning: RoadPlanning, weights: RoadWeights
) -> Situation:
    """Compute what all plans of a step share."""
    s, d, turn = scene.route.project(scene.paths.x, scene.paths.y, scene.paths.heading)
    ways = Ways(s, d, jnp.cos(turn))
    s, d, cosine = ways.at(scene.states[:, 0], scene.states[:, 1])
    leading = (
        (s > scene.robot[0])
        & (cosine > CROSSING)
        & (jnp.abs(d - scene.robot[1]) < scene.size[1])
    )
    inside = inside_of(scene)
    return Situation(
        scene,
        planning,
        weights,
        ways,
        _crossings(scene, ways),
        leading,
        inside,
        speed_caps(scene, planning, inside),
        obstruction_of(scene, weights),
    )


def _crossings(scene: RoadScene, ways: Ways) -> Crossings:
    """Find where paths of traffic cross the robot's route.

    Vehicles in the robot's lane, and those that merge behind the robot, are not
    crossing traffic even if paths part later: one of them follows the other. Nothing
    crosses behind the robot.
    """
    places = jnp.arange(-BEHIND, SPACING * ways.s.shape[-1] - BEHIND, STRIDE)
    s, d, apart, cosine = (
        jax.vmap(interpolate, (0, None))(field, places)
        for field in (ways.s, ways.d, jnp.abs(ways.d), ways.cosine)
    )
    now = int(BEHIND / STRIDE)
    # Not abs(d), since the sign of d may change between knots.
    inside = apart < RoadWeights.corridor
    along = inside & (cosine > SHARING)
    joins = along & (s < scene.robot[0]) & (places >= 0)
    shares = along[:, now] | joins.any(axis=-1)
    oncoming = (
        inside[:, now]
        & (cosine[:, now] < -SHARING)
        & (s[:, now] > scene.robot[0])
        & scene.moving
    )
    aslant = (
        (s > scene.robot[0] - PASSED_MARGIN) & (cosine < SHARING) & ~shares[:, None]
    )
    across = inside & aslant
    line = (
        lowest(s[:, 1:], across[:, 1:] & across[:, :-1])
        - scene.sizes[:, 1] / 2
        - WAITING
    )
    aside = jnp.where(aslant & ~oncoming[:, None], jnp.sign(d) * apart, FREE_GAP)
    return Crossings(
        places,
        s,
        aside,
        oncoming,
        line,
        lowest(places, across),
        highest(places, across),
    )


def lane_of(values: Knots, lanes: PlanLanes, s: Numbers) -> Numbers:
    """Interpolate values that each lane has at the knots of the route, for plans that
    go to one lane each.
    """
    return jax.vmap(lambda lane, s: interpolate(values[lane], s))(lanes, s)


def speed_caps(scene: RoadScene, planning: RoadPlanning, inside: Knots) -> Knots:
    """Return the highest speed at each knot of the route from which gentle braking
    suffices for all bends ahead.
    """
    bends = jnp.maximum(sharpest_bends(scene, inside), 1e-4)
    allowed = jnp.minimum(
        planning.cornering * planning.grip / bends, planning.desired_speed**2
    )
    ahead = 2 * BEND_BRAKING * SPACING * jnp.arange(len(bends))
    return jnp.sqrt(
        jnp.maximum(jax.lax.cummin(allowed + ahead, reverse=True) - ahead, 1.0)
    )


def obstruction_of(scene: RoadScene, weights: RoadWeights) -> Obstruction:
    """Find the obstacles in the robot's lane by the corners of bodies in the
    coordinates of its route.

    Bodies that slide, ``v' = -v``, occupy both their present and their final position.
    """
    along, across, heading, speed = jnp.asarray(scene.states).T[..., None]
    slid = speed * jnp.array([0.0, 1.0])
    x, y, path = jax.vmap(Curve.place)(
        scene.paths, along + slid * jnp.cos(heading), across + slid * jnp.sin(heading)
    )
    ahead, aside = jnp.moveaxis(
        scene.sizes[:, None, None] / 2 * CORNERS, -1, 0
    )  # [traffic, 1, corners]
    turned = path[..., None]
    forth, sideways = rotated(ahead, aside, -turned - scene.askew[..., None])
    in_sight = jax.tree.map(lambda knots: knots[:KNOTS_IN_SIGHT], scene.route)
    s, d, _ = in_sight.project(x[..., None] + forth, y[..., None] + sideways, turned)
    first, last, left, right = (
        bound(each, axis=(1, 2)) for each in (s, d) for bound in (jnp.min, jnp.max)
    )
    needed = scene.size[1] + 2 * weights.comfortable
    own = interpolate(scene.lanes[1], first)
    near = (
        scene.present
        & ~scene.moving
        & (last > scene.robot[0])
        & (first < scene.robot[0] + OBSTACLE_SIGHT)
    )
    found = near & (left < own + needed / 2) & (right > own - needed / 2)

    sides = jnp.stack(
        [lowest(left, found) - needed / 2, highest(right, found) + needed / 2]
    )
    return Obstruction(found.any(), sides, lowest(first, found), highest(last, found))


def lowest(values: Numbers, where: Numbers) -> Numbers:
    """Return the lowest of the values that count in the last axis, `FREE_GAP` where
    none counts.
    """
    return jnp.where(where, values, FREE_GAP).min(axis=-1)


def highest(values: Numbers, where: Numbers) -> Numbers:
    """Return the highest of the values that count in the last axis, minus `FREE_GAP`
    where none counts.
    """
    return jnp.where(where, values, -FREE_GAP).max(axis=-1)
