"""Find what lies in the robot's lane and cannot move, such as a car that has crashed, and the ways round it."""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.geometry.bodies import CORNERS
from ms_highway.geometry.curve import BEHIND, SPACING, Curve, interpolate, rotated
from ms_highway.planning.car_following import highest, lowest
from ms_highway.road.constants import RoadWeights
from ms_highway.road.scene import Flags, RoadScene
from ms_highway.runtime.arrays import Flag, Scalar, Vector

SIGHT = 30.0  # m ahead, in which obstacles are gone round
BESIDE = 5.0  # m along the route, up to which obstacles lie beside each other
ROUNDS = 2  # in which obstacles are added that lie beside those found
KNOTS_IN_SIGHT = int((BEHIND + SIGHT + 10.0) / SPACING)  # of the route, 10 m more: on a loop, not the next lap


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
    """Return what cannot move in the robot's lane, by the corners of bodies in the coordinates of its route.

    Bodies are where they are, and where they will have slid to: ``v' = -v``. Those in the lane count together, and so
    does whoever lies beside them and leaves no room for the robot in between.
    """
    along, across, heading, speed = jnp.asarray(scene.states).T[..., None]
    slid = speed * jnp.array([0.0, 1.0])
    x, y, path = jax.vmap(Curve.place)(scene.paths, along + slid * jnp.cos(heading), across + slid * jnp.sin(heading))
    ahead, aside = jnp.moveaxis(scene.sizes[:, None, None] / 2 * CORNERS, -1, 0)  # [traffic, 1, corners]
    turned = path[..., None]
    forth, sideways = rotated(ahead, aside, -turned - scene.askew[..., None])
    in_sight = jax.tree.map(lambda knots: knots[:KNOTS_IN_SIGHT], scene.route)
    s, d, _ = in_sight.project(x[..., None] + forth, y[..., None] + sideways, turned)
    first, last, left, right = (bound(each, axis=(1, 2)) for each in (s, d) for bound in (jnp.min, jnp.max))
    needed = scene.size[1] + 2 * weights.comfortable
    own = interpolate(scene.lanes[1], first)
    near = scene.present & ~scene.moving & (last > scene.robot[0]) & (first < scene.robot[0] + SIGHT)
    found = in_lane = near & (left < own + needed / 2) & (right > own - needed / 2)

    def extent(found: Flags) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        return lowest(first, found), highest(last, found), lowest(left, found), highest(right, found)

    for _ in range(ROUNDS):
        begin, end, low, high = extent(found)
        beside = (first < end + BESIDE) & (last > begin - BESIDE) & (left < high + needed) & (right > low - needed)
        found = found | (near & beside)
    begin, end, low, high = extent(found)
    return Obstruction(in_lane.any(), jnp.stack([low - needed / 2, high + needed / 2]), begin, end)
