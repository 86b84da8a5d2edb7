"""Predict traffic along its paths: keeping its speed, or following by the Intelligent Driver Model.

All predictions run together with the robot's proposals, step by step, so that cars that follow answer the robot.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.geometry.curve import BEHIND, SPACING, Knots, Pose, interpolate
from ms_highway.planning.car_following import FAR, highest, idm_acceleration, lowest
from ms_highway.road.arrays import EachStep, Steps
from ms_highway.road.constants import RoadPlanning, RoadWeights
from ms_highway.road.motion import speed_caps
from ms_highway.road.obstruction import Obstruction, obstruction_of
from ms_highway.road.scene import Flags, RoadScene, Traffic
from ms_highway.runtime.arrays import Scalar

STANDING = 1.0
"""Speed up to which a car stands [m/s]."""

ROOM, WAITING = 0.4, 0.8
"""Distance between bodies that pass, and between the robot that waits and those who cross [m]."""

SHARING, SAME_WAY, FOLLOWED, CROSSING = 0.85, 0.8, 0.7, 0.5
"""Cosines of the angle between a car's path and the robot's route, from which it shares the lane, goes the same way,
follows the robot if it is behind, and does not cross its way."""

CORRIDOR = 3.0  # m, of the robot's way to each side
PASSED = 1.0  # m, behind the robot's rear axle, where nobody crosses its way any more
STRIDE = 0.5  # m, between places on ways that may cross: knots move with cars, and lines would jump with knots
SETTLING = 1.0  # s, in which cars move to the middle of their path
SLOWLY = 0.6  # share of the speed limit below which cars are expected to speed up to it


class Ways(NamedTuple):
    """Paths of traffic in the coordinates of the robot's route, at the knots of the paths.

    Attributes:
        s, d: position on the route [m].
        cosine: of the angle between the path and the route.
    """

    s: Knots
    d: Knots
    cosine: Knots


class Crossings(NamedTuple):
    """Where paths of traffic cross the robot's route.

    Attributes:
        places: on the paths [m].
        s, d: of these places on the route [m]; d is far away where they do not go at an angle to the route, or lie
            behind the robot, and for oncoming vehicles.
        come: which vehicles come towards the robot in its lane.
        line: position on the route where the front of the robot waits for those who cross it [m].
        begin, last: positions on the path where they begin and end to [m]; far away where they never do.
    """

    places: Steps
    s: Knots
    d: Knots
    come: Flags
    line: Traffic
    begin: Traffic
    last: Traffic

    @property
    def exist(self) -> Flags:
        """Which of the paths cross the route at all."""
        return self.begin < FAR


class Situation(NamedTuple):
    """What all plans of a step are made and judged with.

    Attributes:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        ways: of the traffic.
        crossings: of these ways and the route.
        caps: see `ms_highway.road.motion.speed_caps`.
        obstruction: of the robot's lane.
    """

    scene: RoadScene
    planning: RoadPlanning
    weights: RoadWeights
    ways: Ways
    crossings: Crossings
    caps: Knots
    obstruction: Obstruction


def situation_of(scene: RoadScene, planning: RoadPlanning, weights: RoadWeights) -> Situation:
    """Compute what all plans of a step share."""
    ways = ways_of(scene)
    crossings, caps = _crossings(scene, ways), speed_caps(scene, planning)
    return Situation(scene, planning, weights, ways, crossings, caps, obstruction_of(scene, weights))


def ways_of(scene: RoadScene) -> Ways:
    """Project the paths of traffic on the robot's route."""
    s, d, turn = scene.route.project(scene.paths.x, scene.paths.y, scene.paths.heading)
    return Ways(s, d, jnp.cos(turn))


def _crossings(scene: RoadScene, ways: Ways) -> Crossings:
    """Find where paths of traffic cross the robot's route.

    Vehicles in the robot's lane, and those that merge behind the robot, are not crossing traffic where their ways part:
    one of them follows the other. Nothing crosses behind the robot.
    """
    places = jnp.arange(-BEHIND, SPACING * ways.s.shape[-1] - BEHIND, STRIDE)
    s, d, apart, cosine = (
        jax.vmap(interpolate, (0, None))(field, places) for field in (ways.s, ways.d, jnp.abs(ways.d), ways.cosine)
    )
    now, inside = int(BEHIND / STRIDE), apart < CORRIDOR  # not abs(d): between knots, d may jump to its opposite
    along = inside & (cosine > SHARING)
    joins = along & (s < scene.robot[0]) & (places >= 0)
    shares = along[:, now] | joins.any(axis=-1)
    come = inside[:, now] & (cosine[:, now] < -SHARING) & (s[:, now] > scene.robot[0])
    come = come & scene.moving & scene.present
    aslant = (s > scene.robot[0] - PASSED) & (cosine < SHARING) & ~shares[:, None]
    across = inside & aslant
    line = lowest(s[:, 1:], across[:, 1:] & across[:, :-1]) - scene.sizes[:, 1] / 2 - WAITING
    aside = jnp.where(aslant & ~come[:, None], jnp.sign(d) * apart, FAR)
    return Crossings(places, s, aside, come, line, lowest(places, across), highest(places, across))


def leads(scene: RoadScene, ways: Ways, reach: Scalar) -> Flags:
    """Return which vehicles are ahead of the robot's rear axle, go its way, and are less than this far aside [m]."""
    s, d, cosine = on_route(ways, scene.states[:, 0], scene.states[:, 1])
    return (s > scene.robot[0]) & (jnp.abs(d - scene.robot[1]) < reach) & (cosine > CROSSING)


def follow_all(
    scene: RoadScene, wanted: Traffic, where: Pose, speeds: Traffic, gaps: Traffic, robot: tuple[Scalar, Scalar, Scalar]
) -> Traffic:
    """Return the accelerations of others that follow the car ahead on their path, and the robot in their lane.

    Args:
        scene: the road.
        wanted: speeds that the drivers desire, see `desired_speeds` [m/s].
        where: the others are, see `on_route`.
        speeds: of the others [m/s].
        gaps: distances of centres to the car ahead on their path, where there is one [m].
        robot: s of its centre, its d and its speed.
    """
    s, d, speed = robot
    gaps = jnp.where((scene.leaders >= 0) & scene.present, gaps, FAR)
    in_lane = jnp.abs(where[1] - d) < scene.reach[:, 1] + ROOM
    behind = jnp.where((where[0] < s) & in_lane & (where[2] > FOLLOWED), s - where[0], FAR)
    by_leader = idm_acceleration(speeds, wanted, gaps, speeds[scene.leaders])
    return jnp.minimum(by_leader, idm_acceleration(speeds, wanted, behind, speed))


def desired_speeds(scene: RoadScene) -> Traffic:
    """Return the speeds that others desire: the present ones, or the limit if they are much slower [m/s]."""
    speed = scene.states[:, 3]
    return jnp.where(speed < SLOWLY * scene.limits, scene.limits, speed)


def accelerations_now(scene: RoadScene, ways: Ways, time_step: Scalar) -> Traffic:
    """Return the accelerations now by the Intelligent Driver Model: the least on all ways of a car, never backwards."""
    s, d, _, speed = jnp.asarray(scene.robot)
    speeds = jnp.asarray(scene.states)[:, 3]
    where = on_route(ways, scene.states[:, 0], scene.states[:, 1])
    each = follow_all(scene, desired_speeds(scene), where, speeds, scene.gaps, (s + scene.size[0] / 2, d, speed))
    same = scene.names[:, None] == scene.names
    return jnp.maximum(jnp.where(same, each, jnp.inf).min(axis=1), -speeds / time_step)


def aside(scene: RoadScene, times: Steps) -> EachStep:
    """Return the lateral positions of others on their paths, to the middle of which they settle if they drive.

    A crashed car slides where it heads, more slowly from second to second: ``v' = -v``.
    """
    _, now, heading, speed = scene.states.T[..., None]
    sideways = speed * jnp.sin(heading)
    settles = (now + (sideways + now / SETTLING) * times) * jnp.exp(-times / SETTLING)
    return jnp.where(scene.moving[:, None], settles, now + sideways * (1 - jnp.exp(-times)))


def on_route(ways: Ways, along: Traffic, across: Traffic) -> Pose:
    """Return s and d on the robot's route of others on their paths, and the cosine of the angle between the two."""
    s, d, cosine = (jax.vmap(interpolate)(field, along) for field in ways)
    return s, d + across * cosine, cosine
