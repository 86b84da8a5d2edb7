"""Judge plans where ways cross: who may come early or late, and who must not be kept waiting."""

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.road import BEHIND, SPACING, RoadScene
from ms_highway.planning.road.proposals import STOPPING, Rollouts, waiting_lines
from ms_highway.planning.road.settings import RoadPlanning
from ms_highway.planning.road.traffic import FAR, STANDING, Ways, crossings

__all__ = ["avoidable", "blocks", "occupied"]

CROSSES, EARLY = 0.8, 0.15  # cosine of the angle below which cars may come so much earlier or later [s]
CLEARANCE = 1.0  # m, around where others cross the robot's way
UNSURE = 6.0  # m/s^2, of the accelerations that others may have
DECIDED = 1  # step after which stopping has to be possible
AWAITED = 6.0  # s, in which a crossing car has to come to count


def occupied(scene: RoadScene, planning: RoadPlanning, rollouts: Rollouts) -> Float[jax.Array, "plans traffic steps 2"]:
    """Return length and width of what others may occupy [m]: more of their way where it crosses the robot's.

    Nobody knows when exactly a car comes that may brake or speed up; where it is now is known.
    """
    lengths, widths = (jnp.asarray(scene.sizes)[:, field, None] for field in range(2))
    crossing = rollouts.cosine < CROSSES
    times = planning.time_step * jnp.arange(1, planning.steps + 1)
    early = jnp.minimum(EARLY * rollouts.speeds + 0.5, UNSURE * times**2 / 2)
    early = jnp.where(crossing & (rollouts.speeds > STANDING), early, 0.0)
    return jnp.stack([lengths + 2 * early, jnp.broadcast_to(widths, early.shape)], axis=-1)


def avoidable(scene: RoadScene, ways: Ways, rollouts: Rollouts) -> Bool[jax.Array, "plans traffic"]:
    """Return whether the robot can still stop before where a car crosses its route, soon after a plan has begun."""
    crossing = crossings(ways)
    s, speed = rollouts.states[:, DECIDED, 0, None], rollouts.states[:, DECIDED, 3, None]
    return (crossing.first < FAR) & (waiting_lines(scene, crossing) - s - scene.size[0] > speed**2 / (2 * STOPPING))


def blocks(scene: RoadScene, ways: Ways, rollouts: Rollouts) -> Bool[jax.Array, "plans traffic"]:
    """Return whether the robot, after a plan, is still where a car crosses its route when that car comes.

    The robot goes on as fast as it is then, and faster; the car at its speed.
    """
    knots = SPACING * jnp.arange(ways.s.shape[-1]) - BEHIND
    across = crossings(ways).across
    s, speed = rollouts.states[:, -1, 0, None], rollouts.states[:, -1, 3, None]
    here = across & (ways.s > s[..., None] - CLEARANCE) & (ways.s < s[..., None] + scene.size[0] + CLEARANCE)
    first, last = jnp.where(here, knots, FAR).min(axis=-1), jnp.where(here, knots, -FAR).max(axis=-1)
    high = jnp.where(across, ways.s, -FAR).max(axis=-1)
    leaving = (high + CLEARANCE - s) / (speed + 1.0)
    along, lengths = rollouts.along[..., -1], jnp.asarray(scene.sizes)[:, 0]
    coming = (first - lengths - along) / jnp.maximum(rollouts.speeds[..., -1], 1.0)
    moving = jnp.asarray(scene.present) & jnp.asarray(scene.moving)
    return here.any(axis=-1) & moving & (along < last) & (coming < leaving + 0.5) & (coming < AWAITED)
