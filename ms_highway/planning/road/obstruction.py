"""Find what lies in the robot's lane and cannot move, such as a car that has crashed, and the ways round it."""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.collision_risk import CORNERS
from ms_highway.game.road import RoadScene, Traffic, interpolate, locate, place, rotated
from ms_highway.planning.car_following import FAR
from ms_highway.planning.road.settings import RoadWeights
from ms_highway.runtime.arrays import Flag, Scalar, Vector

SIGHT = 30.0  # m ahead, in which obstacles are gone round
TOGETHER = 3  # obstacles side by side, at most, that are gone round together


class Obstruction(NamedTuple):
    """What cannot move in the robot's lane.

    Attributes:
        exists: whether there is anything.
        sides: lateral positions at which the robot passes it on the left and on the right [m].
        begin, end: positions between which it lies [m].
    """

    exists: Flag
    sides: Vector
    begin: Scalar
    end: Scalar


def obstruction_of(scene: RoadScene, weights: RoadWeights) -> Obstruction:
    """Return what cannot move in the robot's lane, by the corners of bodies in the coordinates of its route."""
    x, y, along = jax.vmap(place)(scene.paths, scene.states[:, :1], scene.states[:, 1:2])
    ahead, aside = jnp.moveaxis(scene.sizes[:, None] / 2 * CORNERS, -1, 0)
    forth, across = rotated(ahead, aside, -along - scene.askew)
    s, d, _ = locate(scene.route, x + forth, y + across, along)
    first, last, left, right = s.min(axis=1), s.max(axis=1), d.min(axis=1), d.max(axis=1)
    needed = scene.size[1] + 2 * weights.comfortable
    own = interpolate(scene.lanes[1], first)
    near = scene.present & ~scene.moving & (last > scene.robot[0]) & (first < scene.robot[0] + SIGHT)
    inside = near & (left < own + needed / 2) & (right > own - needed / 2)

    def outermost(low: Traffic, high: Traffic) -> Scalar:
        """Return how far to one side obstacles reach, those included beside which no robot fits."""
        found = jnp.where(inside, high, -FAR).max()
        for _ in range(TOGETHER - 1):
            found = jnp.maximum(found, jnp.where(near & (low < found + needed), high, -FAR).max())
        return found

    sides = jnp.stack([-outermost(-right, -left) - needed / 2, outermost(left, right) + needed / 2])
    begin, end = jnp.where(inside, first, FAR).min(), jnp.where(inside, last, -FAR).max()
    return Obstruction(inside.any(), sides, begin, end)
