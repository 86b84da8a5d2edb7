"""Predict traffic along its paths: keeping its speed, or following by the Intelligent Driver Model (Treiber 2000).

All predictions run together with the robot's proposals, step by step, so that cars that follow answer the robot.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.road import (
    BEHIND,
    SPACING,
    Knots,
    Number,
    Pose,
    RoadScene,
    Traffic,
    Traits,
    interpolate,
    place,
    project,
)
from ms_highway.planning.road.arrays import EachFlag, EachStep, Scalar, Steps
from ms_highway.planning.road.motion import speed_caps
from ms_highway.planning.road.settings import RoadPlanning, RoadWeights

FAR = 1e3
"""Distance to what is not there [m]."""

ROOM = 0.4
"""Lateral distance between bodies that pass [m]."""

STANDING = 1.0
"""Speed up to which a car stands [m/s]."""

COMFORTABLE, BRAKING, HEADWAY, STANDSTILL = 3.0, 5.0, 1.5, 10.0  # m/s^2, m/s^2, s, m between centres: highway-env's
HARDEST = 6.0  # m/s^2, of braking
SETTLING = 1.0  # s, in which cars move to the middle of their path
SHARED = 0.85  # cosine of the angle from which cars share a lane
CORRIDOR = 3.0  # m, of the robot's way to each side
SAME_WAY = 0.7  # cosine of the angle up to which a car behind follows the robot
SLOWLY = 0.6  # share of the speed limit below which cars are expected to speed up to it
WAITING = 1.2  # m, between the robot that waits and those who cross


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
        across: at which knots they do.
        first: position on the route where they begin to [m]; far away where they never do.
        line: position on the route where the front of the robot waits for those who cross it [m].
        begin, last: positions on the path where they begin and end to [m].
    """

    across: EachFlag
    first: Traffic
    line: Traffic
    begin: Traffic
    last: Traffic


class Situation(NamedTuple):
    """What all plans of a step are made and judged with.

    Attributes:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        ways: of the traffic.
        crossings: of these ways and the route.
        caps: see `ms_highway.planning.road.motion.speed_caps`.
    """

    scene: RoadScene
    planning: RoadPlanning
    weights: RoadWeights
    ways: Ways
    crossings: Crossings
    caps: Knots


def situation_of(scene: RoadScene, planning: RoadPlanning, weights: RoadWeights) -> Situation:
    """Compute what all plans of a step share."""
    ways = ways_of(scene)
    return Situation(scene, planning, weights, ways, _crossings(scene, ways), speed_caps(scene, planning))


def ways_of(scene: RoadScene) -> Ways:
    """Project the paths of traffic on the robot's route."""
    s, d, turn = project(scene.route, scene.paths.x, scene.paths.y, scene.paths.heading)
    return Ways(s, d, jnp.cos(turn))


def _crossings(scene: RoadScene, ways: Ways) -> Crossings:
    """Find where paths of traffic cross the robot's route.

    Who is in the robot's lane does not cross it where their ways part: one of them follows the other.
    """
    now, inside = int(BEHIND / SPACING), jnp.abs(ways.d) < CORRIDOR
    sharing = inside[:, now] & (ways.cosine[:, now] > SHARED)
    across = inside & (ways.cosine < SHARED) & ~sharing[:, None]
    first, knots = least(ways.s, across), way_knots(ways)
    line = first - scene.sizes[:, 1] / 2 - WAITING
    return Crossings(across, first, line, least(knots, across), -least(-knots, across))


def way_knots(ways: Ways) -> Knots:
    """Return the positions of the knots on the paths [m]."""
    return SPACING * jnp.arange(ways.s.shape[-1]) - BEHIND


def least(values: Number, where: Number) -> Number:
    """Return the least of values in the last axis of those that count, `FAR` where none does."""
    return jnp.where(where, values, FAR).min(axis=-1)


def follow(
    speed: Number, wanted: Number, gap: Number, ahead: Number, headway: Number = HEADWAY, standstill: float = STANDSTILL
) -> Number:
    """Return the acceleration of the Intelligent Driver Model, by default with highway-env's parameters.

    Args:
        speed: of the follower [m/s].
        wanted: its desired speed [m/s].
        gap: to the car ahead [m]; infinite without one. It is that of centres in highway-env.
        ahead: speed of that car [m/s].
        headway: desired time gap [s].
        standstill: desired gap of standing cars, between bumpers or centres as the gap is [m].
    """
    closing = speed * (speed - ahead) / (2 * (COMFORTABLE * BRAKING) ** 0.5)
    desired = standstill + jnp.maximum(speed * headway + closing, 0.0)
    free = 1 - (speed / jnp.maximum(wanted, 0.1)) ** 4
    return jnp.clip(COMFORTABLE * (free - (desired / jnp.maximum(gap, 0.5)) ** 2), -HARDEST, COMFORTABLE)


def follow_all(
    scene: RoadScene, traits: Traits, where: Pose, speeds: Traffic, gaps: Traffic, robot: tuple[Scalar, Number, Scalar]
) -> Traffic:
    """Return the accelerations of others that follow the car ahead on their path, and the robot in their lane.

    Args:
        scene: the road.
        traits: of the drivers.
        where: the others are, see `on_route`.
        speeds: of the others [m/s].
        gaps: distances of centres to the car ahead on their path, where there is one [m].
        robot: s of its centre, all d at which it is followed, and its speed.
    """
    s, d, speed = robot
    gaps = jnp.where((scene.leaders >= 0) & scene.present, gaps, FAR)
    beside = (jnp.abs(where[1] - d[:, None]) < scene.reach[:, 1] + ROOM).any(axis=0)
    behind = jnp.where((where[0] < s) & beside & (where[2] > SAME_WAY), s - where[0], FAR)
    by_leader = follow(speeds, traits.speed, gaps, speeds[scene.leaders], traits.headway)
    return jnp.minimum(by_leader, follow(speeds, traits.speed, behind, speed, traits.headway))


def expected_traits(scene: RoadScene) -> Traits:
    """Return what drivers are like.

    Where nothing is known of them, they desire the present speeds, or the limit if they are much slower, and
    highway-env's headway.
    """
    if scene.traits is not None:
        return scene.traits
    speed = scene.states[:, 3]
    wanted = jnp.where(speed < SLOWLY * scene.limits, scene.limits, speed)
    return Traits(wanted, jnp.full_like(wanted, HEADWAY))


def aside(scene: RoadScene, times: Steps) -> EachStep:
    """Return the lateral positions of others on their paths, to the middle of which they settle."""
    now, heading, speed = (scene.states[:, field, None] for field in (1, 2, 3))
    rate = 1 / SETTLING
    drift = speed * jnp.sin(heading) + rate * now
    return (now + drift * times) * jnp.exp(-rate * times)


def positions(scene: RoadScene, along: EachStep, across: EachStep) -> Pose:
    """Return x, y and heading of others in world coordinates from where they are on their paths."""
    return jax.vmap(place, (0, -2, -2), -2)(scene.paths, along, across)


def on_route(ways: Ways, along: Traffic, across: Traffic) -> Pose:
    """Return s and d on the robot's route of others on their paths, and the cosine of the angle between the two."""
    s, d, cosine = (jax.vmap(interpolate)(field, along) for field in ways)
    return s, d + across * cosine, cosine
