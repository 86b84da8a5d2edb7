"""Predict traffic along its paths: keeping its speed, or following by the Intelligent Driver Model (Treiber 2000).

All predictions run together with the robot's proposals, step by step, so that cars that follow answer the robot.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.road import BEHIND, SPACING, RoadScene, interpolate, place, project

__all__ = [
    "FAR",
    "ROOM",
    "STANDING",
    "Crossings",
    "Ways",
    "aside",
    "crossings",
    "follow",
    "gaps_to_robot",
    "headways",
    "on_route",
    "positions",
    "wanted_speeds",
    "ways_of",
]

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


class Ways(NamedTuple):
    """Paths of traffic in the coordinates of the robot's route, at the knots of the paths.

    Attributes:
        s, d: position on the route [m].
        cosine: of the angle between the path and the route.
    """

    s: Float[jax.Array, "traffic knots"]
    d: Float[jax.Array, "traffic knots"]
    cosine: Float[jax.Array, "traffic knots"]


def ways_of(scene: RoadScene) -> Ways:
    """Project the paths of traffic on the robot's route."""
    paths = scene.paths
    s, d, turn = project(scene.route, *(jnp.asarray(field) for field in (paths.x, paths.y, paths.heading)))
    return Ways(s, d, jnp.cos(turn))


class Crossings(NamedTuple):
    """Where paths of traffic cross the robot's route.

    Attributes:
        across: at which knots they do.
        first: position on the route where they begin to [m]; far away where they never do.
        begin, last: positions on the path where they begin and end to [m].
    """

    across: Bool[jax.Array, "traffic knots"]
    first: Float[jax.Array, "traffic"]
    begin: Float[jax.Array, "traffic"]
    last: Float[jax.Array, "traffic"]


def crossings(ways: Ways) -> Crossings:
    """Find where paths of traffic cross the robot's route.

    Who is in the robot's lane does not cross it where their ways part: one of them follows the other.
    """
    knots = SPACING * jnp.arange(ways.s.shape[-1]) - BEHIND
    now = int(BEHIND / SPACING)
    sharing = (jnp.abs(ways.d[:, now]) < CORRIDOR) & (ways.cosine[:, now] > SHARED)
    across = (jnp.abs(ways.d) < CORRIDOR) & (ways.cosine < SHARED) & ~sharing[:, None]
    first = jnp.where(across, ways.s, FAR).min(axis=-1)
    begin, last = jnp.where(across, knots, FAR).min(axis=-1), jnp.where(across, knots, -FAR).max(axis=-1)
    return Crossings(across, first, begin, last)


def follow(
    speed: Float[jax.Array, "*shape"],
    wanted: float | Float[jax.Array, "*shape"],
    gap: Float[jax.Array, "*shape"],
    ahead: Float[jax.Array, "*shape"],
    headway: float | Float[jax.Array, "*shape"] = HEADWAY,
    standstill: float = STANDSTILL,
) -> Float[jax.Array, "*shape"]:
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


def wanted_speeds(scene: RoadScene) -> Float[jax.Array, "traffic"]:
    """Return the speeds that others desire.

    Where nothing is known of their drivers, these are the present ones, or the limit if they are much slower.
    """
    if scene.traits is not None:
        return jnp.asarray(scene.traits.speed)
    speed = jnp.asarray(scene.states)[:, 3]
    return jnp.where(speed < SLOWLY * jnp.asarray(scene.limits), scene.limits, speed)


def headways(scene: RoadScene) -> float | Float[jax.Array, "traffic"]:
    """Return the time gaps that others desire [s]; highway-env's where nothing is known of their drivers."""
    return HEADWAY if scene.traits is None else jnp.asarray(scene.traits.headway)


def gaps_to_robot(
    s: Float[jax.Array, ""],
    d: Float[jax.Array, ""],
    where: tuple[jax.Array, jax.Array, jax.Array],
    apart: Float[jax.Array, "traffic"],
) -> Float[jax.Array, "traffic"]:
    """Return the distances of others to the robot's centre where they follow it [m], `FAR` where they do not.

    Args:
        s: of the robot's centre [m].
        d: of the robot [m].
        where: the others are, see `on_route`.
        apart: lateral distance up to which they follow it [m].
    """
    before = (where[0] < s) & (jnp.abs(where[1] - d) < apart) & (where[2] > SAME_WAY)
    return jnp.where(before, s - where[0], FAR)


def aside(scene: RoadScene, times: Float[jax.Array, "steps"]) -> Float[jax.Array, "traffic steps"]:
    """Return the lateral positions of others on their paths, to the middle of which they settle."""
    now, heading, speed = (jnp.asarray(scene.states)[:, field, None] for field in (1, 2, 3))
    rate = 1 / SETTLING
    drift = speed * jnp.sin(heading) + rate * now
    return (now + drift * times) * jnp.exp(-rate * times)


def positions(
    scene: RoadScene, along: Float[jax.Array, "traffic steps"], across: Float[jax.Array, "traffic steps"]
) -> tuple[Float[jax.Array, "traffic steps"], Float[jax.Array, "traffic steps"], Float[jax.Array, "traffic steps"]]:
    """Return x, y and heading of others in world coordinates from where they are on their paths."""
    return jax.vmap(place)(scene.paths, along, across)


def on_route(
    ways: Ways, along: Float[jax.Array, "traffic"], across: Float[jax.Array, "traffic"]
) -> tuple[Float[jax.Array, "traffic"], Float[jax.Array, "traffic"], Float[jax.Array, "traffic"]]:
    """Return s and d on the robot's route of others on their paths, and the cosine of the angle between the two."""
    s, d, cosine = (jax.vmap(interpolate)(field, along) for field in ways)
    return s, d + across * cosine, cosine
