"""Judge what follows a plan: room to stop, the speed that the lanes allow, and the way to the goal's lane."""

from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.road import RoadScene, interpolate
from ms_highway.planning.road.proposals import Rollouts
from ms_highway.planning.road.settings import RoadPlanning

__all__ = ["missing_room", "prospects", "pushes_from_behind", "urgency"]

FAR = 1e3  # m
WIDTH = 4.0  # m, of lanes
SIDE_LANES = np.arange(-2.0, 3.0, dtype=np.float32)  # to the right of the one that a plan ends in
SECONDS_AFTER = 8  # s, of what follows a plan
SECONDS_TO_CLOSE_UP, KEPT, CHANGING = 3.0, 5.0, 0.7  # s, m, m/s: see `prospects`
ROOM_BEHIND, ROOM_AHEAD = 5.0, 3.0  # m, that a change of lane needs
REACTION = 0.2  # s
SLOWING_DOWN = 2.0  # m/s^2, with which a car ahead may brake
CROSSING = 0.5  # cosine of the angle up to which cars cross the robot's way rather than share it
STANDING = 1.0  # m/s
STOPPING = 0.9  # share of the grip that a full stop may take
SECONDS_PER_CHANGE = 2.0  # s, that a change of lane may take


def missing_room(
    scene: RoadScene, planning: RoadPlanning, rollouts: Rollouts, goal: Float[jax.Array, "plans"]
) -> Float[jax.Array, "plans traffic"]:
    """Return what is missing to stop behind each car ahead after a plan [m]."""
    s, d, _, speed = jnp.moveaxis(rollouts.states[:, -1], -1, 0)
    there, across, cosine = rollouts.s[..., -1], rollouts.d[..., -1], rollouts.cosine[..., -1]
    apart = (scene.size[1] + jnp.asarray(scene.sizes)[:, 1]) / 2 + 0.2
    middle = (s + scene.size[0] / 2)[:, None]
    low, high = jnp.minimum(goal, d)[:, None] - apart, jnp.maximum(goal, d)[:, None] + apart
    front = (there > middle) & (across > low) & (across < high) & jnp.asarray(scene.present)
    front = front & ((cosine > CROSSING) | (rollouts.speeds[..., -1] < STANDING))
    gap = there - middle - (scene.size[0] + jnp.asarray(scene.sizes)[:, 0]) / 2
    onward = rollouts.speeds[..., -1] * cosine
    closing = jnp.maximum(speed[:, None] - onward, 0.0)
    needed = 1.0 + REACTION * speed[:, None] + closing**2 / (2 * (STOPPING * planning.grip - SLOWING_DOWN))
    return jnp.where(front & (onward < speed[:, None]), jnp.maximum(needed - gap, 0.0), 0.0)


def prospects(
    scene: RoadScene, rollouts: Rollouts, goal: Float[jax.Array, "plans"], limit: Float[jax.Array, "plans"]
) -> tuple[Float[jax.Array, "plans"], Bool[jax.Array, "plans traffic"]]:
    """Return the mean speed in the seconds after each plan [m/s], and who of the others limits it first.

    All go on as points in their lanes, the others at the speed that they have then. Every second, the robot takes the
    best lane that is free beside it, among those within two of the one that the plan ends in.
    """
    s, speed = rollouts.states[:, -1, 0] + scene.size[0] / 2, rollouts.states[:, -1, 3]
    left, right = (interpolate(jnp.asarray(scene.edges)[side], s)[:, None] for side in range(2))
    lanes = goal[:, None] + WIDTH * SIDE_LANES  # [plans, lanes]
    there = ((lanes > left + WIDTH / 4) & (lanes < right - WIDTH / 4)) | (SIDE_LANES == 0)
    onward = jnp.maximum(rollouts.speeds[..., -1] * rollouts.cosine[..., -1], 0.0)
    reach = (scene.size[0] + jnp.asarray(scene.sizes)[:, 0]) / 2
    inside = jnp.abs(rollouts.d[..., -1][:, None] - lanes[..., None]) < WIDTH / 2 + 0.5  # [plans, lanes, traffic]
    along = (jnp.abs(rollouts.cosine[..., -1]) > CROSSING) | (rollouts.speeds[..., -1] < STANDING)
    inside = inside & (along & jnp.asarray(scene.present))[:, None]

    def allow(gaps: jax.Array) -> jax.Array:
        """Return the speed that each car allows [plans, traffic]."""
        return jnp.where(gaps > -reach, onward + jnp.maximum(gaps - KEPT, 0.0) / SECONDS_TO_CLOSE_UP, FAR)

    def go(carry: Any, number: jax.Array) -> tuple[Any, jax.Array]:
        place, speed, lane = carry
        gaps = rollouts.s[..., -1] + onward * number - place[:, None] - reach
        allowed = jnp.where(inside, allow(gaps)[:, None], FAR).min(axis=-1)
        beside = (inside & ((gaps > -2 * reach - ROOM_BEHIND) & (gaps < ROOM_AHEAD))[:, None]).any(axis=-1)
        away = jnp.abs(jnp.arange(len(SIDE_LANES)) - lane[:, None])
        worth = jnp.minimum(allowed, limit[:, None]) - CHANGING * away
        lane = jnp.argmax(jnp.where(there & ((away == 0) | ((away == 1) & ~beside)), worth, -jnp.inf), axis=1)
        mine = jnp.minimum(jnp.take_along_axis(allowed, lane[:, None], axis=1)[:, 0], limit)
        after = speed + jnp.clip(mine - speed, -4.0, 2.0)
        return (place + after, after, lane), after

    start = s, speed, jnp.full(len(s), len(SIDE_LANES) // 2)
    (_, _, _), speeds = jax.lax.scan(go, start, jnp.arange(SECONDS_AFTER))
    own = jnp.where(inside[:, len(SIDE_LANES) // 2], allow(rollouts.s[..., -1] - s[:, None] - reach), FAR)
    return speeds.mean(axis=0), (own == own.min(axis=-1, keepdims=True)) & (own < limit[:, None])


def urgency(scene: RoadScene, planning: RoadPlanning, lanes: jax.Array) -> jax.Array:
    """Return the number of changes of lane that are left from each lane, less where there is room for them."""
    left = jnp.abs(jnp.asarray(scene.changes))
    needed = left * jnp.maximum(scene.robot[3], 8.0) * SECONDS_PER_CHANGE
    return (left * jnp.exp(-jnp.maximum(scene.room - needed, 0.0) / 40.0))[lanes]


def pushes_from_behind(
    scene: RoadScene, rollouts: Rollouts, s: jax.Array, d: jax.Array, lanes: jax.Array
) -> Bool[jax.Array, "plans traffic steps"]:
    """Return where a follower in the robot's own lane would run into it while it keeps its lane."""
    behind = rollouts.s < s[:, None] - 1.0
    mine = jnp.abs(rollouts.d - d[:, None]) < scene.size[1]
    follower = behind[..., :1] & mine[..., :1] & (rollouts.cosine > 0.5)
    return follower & behind & (lanes == 1)[:, None, None]
