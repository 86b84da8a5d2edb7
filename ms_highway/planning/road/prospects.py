"""Judge what follows a plan: room to stop, the speed that the lanes allow, and the way to the goal's lane."""

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.road import RoadScene, interpolate
from ms_highway.planning.road.proposals import Rollouts
from ms_highway.planning.road.settings import RoadPlanning
from ms_highway.planning.road.traffic import FAR, STANDING

__all__ = ["missing_room", "prospects", "pushes_from_behind", "urgency"]

WIDTH = 4.0  # m, of lanes
AROUND = 2  # lanes to each side of the robot's that it may use after a plan
SECONDS_AFTER = 8  # s, of what follows a plan
PLACES, SPEEDS = 144, 13  # of the table of what follows
BRAKING, SPEEDING = 2, 1  # steps of speed in a second at most
BLOCKED, CHANGE = 30.0, 0.3  # steps of speed that a second in the way of others and a change of lane count
SECONDS_TO_CLOSE_UP, KEPT = 3.0, 5.0  # s, m, of who limits the speed
ROOM_BEHIND, ROOM_AHEAD, GENTLE = 3.0, 1.0, 2.5  # m, m, m/s^2: to others after a plan
REACTION, LEAST_GAP = 0.2, 0.2  # s
SAME_WAY = 0.8  # cosine of the angle up to which cars go the robot's way
DISTURBED = 25.0  # m, to a car that joins, up to which others may change lanes for it
SLOWING_DOWN = 2.0  # m/s^2, with which a car ahead may brake
CROSSING = 0.5  # cosine of the angle up to which cars cross the robot's way rather than share it
STOPPING = 0.9  # share of the grip that a full stop may take
SECONDS_PER_CHANGE = 2.0  # s, that a change of lane may take


def missing_room(
    scene: RoadScene, planning: RoadPlanning, rollouts: Rollouts, goal: Float[jax.Array, "plans"]
) -> Float[jax.Array, "plans traffic"]:
    """Return what is missing to stop behind each car ahead after a plan [m].

    A car that joins the road, and those near it, may change to the next lane at once, without looking.
    """
    s, d, _, speed = jnp.moveaxis(rollouts.states[:, -1], -1, 0)
    there, across, cosine = rollouts.s[..., -1], rollouts.d[..., -1], rollouts.cosine[..., -1]
    apart = (scene.size[1] + jnp.asarray(scene.sizes)[:, 1]) / 2 + 0.2
    reach = (scene.size[0] + jnp.asarray(scene.sizes)[:, 0]) / 2
    middle = (s + scene.size[0] / 2)[:, None]
    low, high = jnp.minimum(goal, d)[:, None] - apart, jnp.maximum(goal, d)[:, None] + apart
    left, right = (interpolate(jnp.asarray(scene.edges)[side], rollouts.s[..., 0]) for side in range(2))
    present = jnp.asarray(scene.present)
    joins = ((rollouts.d[..., 0] < left) | (rollouts.d[..., 0] > right)) & (cosine > SAME_WAY) & present
    disturbed = (joins[:, None] & (jnp.abs(there[:, :, None] - there[:, None]) < DISTURBED)).any(axis=-1)
    beside = jnp.where(disturbed, WIDTH, 0.0)
    front = (there > middle) & (across > low - beside) & (across < high + beside) & present
    front = front & ((cosine > CROSSING) | (rollouts.speeds[..., -1] < STANDING))
    onward = rollouts.speeds[..., -1] * cosine
    closing = jnp.maximum(speed[:, None] - onward, 0.0)
    needed = 1.0 + REACTION * speed[:, None] + closing**2 / (2 * (STOPPING * planning.grip - SLOWING_DOWN))
    missing = jnp.where(front & (onward < speed[:, None]), jnp.maximum(needed - there + middle + reach, 0.0), 0.0)
    return jnp.maximum(missing, _too_close(scene, rollouts, apart, reach))


def _too_close(
    scene: RoadScene, rollouts: Rollouts, apart: Float[jax.Array, "traffic"], reach: Float[jax.Array, "traffic"]
) -> Float[jax.Array, "plans traffic"]:
    """Return what is missing to the least gap to each car ahead in a plan, less what is missing at its begin [m]."""
    s, d, _, speed = (field[:, None] for field in jnp.moveaxis(rollouts.states, -1, 0))
    ahead = rollouts.s - s - scene.size[0] / 2
    led = (ahead > 0) & (jnp.abs(rollouts.d - d) < apart[:, None]) & (rollouts.cosine > SAME_WAY)
    led = led & jnp.asarray(scene.present)[:, None]
    missing = jnp.where(led, jnp.maximum(LEAST_GAP * speed + reach[:, None] - ahead, 0.0), 0.0)
    return jnp.maximum(missing.max(axis=-1) - missing[..., 0], 0.0)


def prospects(
    scene: RoadScene, planning: RoadPlanning, rollouts: Rollouts, lanes: Int[jax.Array, "plans"], caps: jax.Array
) -> tuple[Float[jax.Array, "plans"], Bool[jax.Array, "plans traffic"]]:
    """Return the mean loss of speed in the seconds after each plan [m/s], and who of the others limits it first.

    All go on as points in their lanes, the others at the speed that they have then in the median of all plans. The
    robot drives as well as it can: dynamic programming over lanes, places and speeds.

    Args:
        scene: the road.
        planning: limits and wishes.
        rollouts: of the plans.
        lanes: that each goes to, 0 to 2.
        caps: see `ms_highway.planning.road.proposals.speed_caps`.
    """
    fastest = jnp.asarray(planning.desired_speed, float)
    values = _values(scene, fastest, rollouts, caps)
    step = fastest / (SPEEDS - 1)
    s, speed = rollouts.states[:, -1, 0] + scene.size[0] / 2, rollouts.states[:, -1, 3]
    place, pace = jnp.clip(s / step, 0.0, PLACES - 1.01), jnp.clip(speed / step, 0.0, SPEEDS - 1.01)
    low, slow = place.astype(int), pace.astype(int)
    far, fast = place - low, pace - slow
    lane = lanes + AROUND - 1
    behind = values[lane, low, slow] * (1 - fast) + values[lane, low, slow + 1] * fast
    ahead = values[lane, low + 1, slow] * (1 - fast) + values[lane, low + 1, slow + 1] * fast
    lost = -(behind * (1 - far) + ahead * far) * step / SECONDS_AFTER
    goal = jax.vmap(lambda lane, s: interpolate(jnp.asarray(scene.lanes)[lane], s))(lanes, s)
    gap, onward, inside = _traffic(scene, rollouts, goal[:, None])
    gap = gap - s[:, None]
    reach = (scene.size[0] + jnp.asarray(scene.sizes)[:, 0]) / 2
    allowed = onward + jnp.maximum(gap - reach - KEPT, 0.0) / SECONDS_TO_CLOSE_UP
    allowed = jnp.where(inside[:, 0] & (gap > 0), allowed, FAR)
    return lost, (allowed == allowed.min(axis=-1, keepdims=True)) & (allowed < fastest)


def _traffic(
    scene: RoadScene, rollouts: Rollouts, centres: Float[jax.Array, "plans lanes"]
) -> tuple[
    Float[jax.Array, "plans traffic"], Float[jax.Array, "plans traffic"], Bool[jax.Array, "plans lanes traffic"]
]:
    """Return where others are after each plan [m], how fast they go on along the route [m/s], and in which lanes."""
    onward = jnp.maximum(rollouts.speeds[..., -1] * rollouts.cosine[..., -1], 0.0)
    along = (jnp.abs(rollouts.cosine[..., -1]) > CROSSING) | (rollouts.speeds[..., -1] < STANDING)
    inside = jnp.abs(rollouts.d[..., -1][:, None] - centres[..., None]) < WIDTH / 2 + 0.5
    return rollouts.s[..., -1], onward, inside & (along & jnp.asarray(scene.present))[:, None]


def _values(
    scene: RoadScene, fastest: jax.Array, rollouts: Rollouts, caps: jax.Array
) -> Float[jax.Array, "lanes places speeds"]:
    """Return minus the loss of speed that is left from each lane, place and speed after a plan [steps of speed].

    Places are as far apart as a step of speed goes in a second, so that all ways lead from place to place.
    """
    step = fastest / (SPEEDS - 1)
    places, speeds = step * jnp.arange(PLACES), step * jnp.arange(SPEEDS)
    centres = WIDTH * jnp.arange(-AROUND, AROUND + 1.0)
    left, right = (interpolate(jnp.asarray(scene.edges)[side], places) for side in range(2))
    there = (centres[:, None] > left + WIDTH / 4) & (centres[:, None] < right - WIDTH / 4)
    there = there.at[AROUND].set(True)
    s, onward, inside = (
        jnp.median(field, axis=0) for field in _traffic(scene, rollouts, jnp.tile(centres, (len(rollouts.s), 1)))
    )
    reach = (scene.size[0] + jnp.asarray(scene.sizes)[:, 0]) / 2
    seconds = jnp.arange(SECONDS_AFTER + 1)
    ahead = (s + onward * seconds[:, None])[:, None, None] - places[:, None]  # [seconds, 1, places, traffic]
    ahead = jnp.where((inside > 0.5)[:, None] & (ahead > -reach - ROOM_BEHIND), ahead - reach, FAR)
    nearest = jnp.argmin(ahead, axis=-1)
    gap = jnp.take_along_axis(ahead, nearest[..., None], axis=-1)
    closing = jnp.maximum(speeds - onward[nearest][..., None], 0.0)
    free = gap > ROOM_AHEAD + REACTION * speeds + closing**2 / (2 * GENTLE)  # [seconds, lanes, places, speeds]
    loss = jnp.maximum(jnp.minimum(interpolate(caps, places), fastest)[:, None] / step - jnp.arange(SPEEDS), 0.0)
    free = free & there[..., None]
    hindered = jnp.where(free, 0.0, BLOCKED)

    def back(value: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        """Return the values a second earlier: the best change of speed, then of lane into one that is free already."""
        before, after = now
        value = jnp.pad(value - after - loss, ((0, 0), (0, SPEEDS), (0, 0)), mode="edge")
        value = jnp.stack([value[:, speed : speed + PLACES, speed] for speed in range(SPEEDS)], axis=-1)
        value = jnp.pad(value, ((0, 0), (0, 0), (BRAKING, SPEEDING)), constant_values=-FAR)
        changes = [value[..., change : change + SPEEDS] for change in range(BRAKING + SPEEDING + 1)]
        value = jnp.stack(changes).max(axis=0)
        aside = jnp.pad(value - before - CHANGE, ((1, 1), (0, 0), (0, 0)), constant_values=-FAR)
        return jnp.maximum(value, jnp.maximum(aside[:-2], aside[2:])), None

    return jax.lax.scan(back, jnp.zeros(free.shape[1:]), (hindered[:-1], hindered[1:]), reverse=True)[0]


def urgency(scene: RoadScene, planning: RoadPlanning, lanes: jax.Array) -> jax.Array:
    """Return the number of changes of lane that are left from each lane, less where there is room for them."""
    left = jnp.abs(jnp.asarray(scene.changes))
    needed = left * jnp.maximum(scene.robot[3], 8.0) * SECONDS_PER_CHANGE
    return (left * jnp.exp(-jnp.maximum(scene.room - needed, 0.0) / 40.0))[lanes]


def pushes_from_behind(
    scene: RoadScene, rollouts: Rollouts, s: jax.Array, d: jax.Array, lanes: jax.Array
) -> Bool[jax.Array, "plans traffic steps"]:
    """Return where a follower in the robot's own lane would run into it, or through it, while it keeps its lane."""
    behind = rollouts.s[..., :1] < s[:, None, :1] - 1.0
    mine = jnp.abs(rollouts.d - d[:, None]) < scene.size[1]
    followed = jnp.cumprod(mine, axis=-1) > 0
    return behind & followed & (rollouts.cosine > 0.5) & (lanes == 1)[:, None, None]
