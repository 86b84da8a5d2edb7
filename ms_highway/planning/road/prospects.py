"""Judge what follows a plan: room to stop, the speed that the lanes allow, and the way to the goal's lane."""

import jax
from jax import numpy as jnp

from ms_highway.game.road import Knots, Number, RoadScene, interpolate
from ms_highway.planning.road.arrays import EachCar, EachFlag, Lane, Plans, Values
from ms_highway.planning.road.proposals import Rollouts
from ms_highway.planning.road.traffic import FAR, STANDING, Situation

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


def lane_of(values: Knots, lanes: Lane, s: Number) -> Number:
    """Interpolate values that each lane has at the knots of the route, for plans that go to one lane each."""
    return jax.vmap(lambda lane, s: interpolate(jnp.asarray(values)[lane], s))(lanes, s)


def urgency(scene: RoadScene, lanes: Lane) -> Plans:
    """Return the number of changes of lane that are left from each lane, less where there is room for them."""
    left = jnp.abs(jnp.asarray(scene.changes))
    needed = left * jnp.maximum(scene.robot[3], 8.0) * SECONDS_PER_CHANGE
    return (left * jnp.exp(-jnp.maximum(scene.room - needed, 0.0) / 40.0))[lanes]


def missing_room(now: Situation, rollouts: Rollouts, goal: Plans) -> EachCar:
    """Return what is missing to stop behind each car ahead after a plan, or to the least gap within it [m].

    A car that joins the road, and those near it, may change to the next lane at once, without looking. What is missing
    to the least gap when a plan begins does not count.
    """
    scene, (s, d, _, speed) = now.scene, rollouts.robot
    reach, apart = scene.reach[:, 0], scene.reach[:, 1] + 0.2
    gap = rollouts.s - s - scene.size[0] / 2
    led = (gap > 0) & (jnp.abs(rollouts.d - d) < apart[:, None]) & (rollouts.cosine > SAME_WAY) & scene.present[:, None]
    close = jnp.where(led, jnp.maximum(LEAST_GAP * speed + reach[:, None] - gap, 0.0), 0.0)

    s, d, speed = s[..., -1], d[..., -1], speed[..., -1]
    there, across, speeds, cosine = (field[..., -1] for field in rollouts[4:])
    left, right = interpolate(scene.edges, rollouts.s[..., 0])
    joins = ((rollouts.d[..., 0] < left) | (rollouts.d[..., 0] > right)) & (cosine > SAME_WAY) & scene.present
    disturbed = (joins[:, None] & (jnp.abs(there[:, :, None] - there[:, None]) < DISTURBED)).any(axis=-1)
    beside, middle = jnp.where(disturbed, WIDTH, 0.0), s + scene.size[0] / 2
    low, high = jnp.minimum(goal[:, None], d) - apart - beside, jnp.maximum(goal[:, None], d) + apart + beside
    front = (there > middle) & (across > low) & (across < high) & scene.present
    onward = speeds * cosine
    counts = front & ((cosine > CROSSING) | (speeds < STANDING)) & (onward < speed)
    closing = jnp.maximum(speed - onward, 0.0)
    needed = 1.0 + REACTION * speed + closing**2 / (2 * (STOPPING * now.planning.grip - SLOWING_DOWN))
    missing = jnp.where(counts, jnp.maximum(needed - there + middle + reach, 0.0), 0.0)
    return jnp.maximum(missing, jnp.maximum(close.max(axis=-1) - close[..., 0], 0.0))


def prospects(now: Situation, rollouts: Rollouts, lanes: Lane) -> tuple[Plans, EachFlag]:
    """Return the mean loss of speed in the seconds after each plan [m/s], and who of the others limits it first.

    All go on as points in their lanes, the others at the speed that they have then in the median of all plans. The
    robot drives as well as it can: dynamic programming over lanes, places and speeds.
    """
    scene, fastest = now.scene, jnp.asarray(now.planning.desired_speed, float)
    step, values = fastest / (SPEEDS - 1), _values(now, rollouts)
    s, speed = rollouts.states[:, -1, 0] + scene.size[0] / 2, rollouts.states[:, -1, 3]
    place, pace = jnp.clip(s / step, 0.0, PLACES - 1.01), jnp.clip(speed / step, 0.0, SPEEDS - 1.01)
    low, slow = place.astype(int), pace.astype(int)
    far, fast = place - low, pace - slow

    def between_speeds(place: Lane) -> Plans:
        lane = lanes + AROUND - 1
        return values[lane, place, slow] * (1 - fast) + values[lane, place, slow + 1] * fast

    lost = -(between_speeds(low) * (1 - far) + between_speeds(low + 1) * far) * step / SECONDS_AFTER
    there, onward, inside = _traffic(scene, rollouts, lane_of(scene.lanes, lanes, s)[:, None])
    gap = there - s[:, None]
    allowed = onward + jnp.maximum(gap - scene.reach[:, 0] - KEPT, 0.0) / SECONDS_TO_CLOSE_UP
    allowed = jnp.where(inside[:, 0] & (gap > 0), allowed, FAR)
    return lost, (allowed == allowed.min(axis=-1, keepdims=True)) & (allowed < fastest)


def _traffic(scene: RoadScene, rollouts: Rollouts, centres: Plans) -> tuple[EachCar, EachCar, EachFlag]:
    """Return where others are after each plan [m], how fast they go on along the route [m/s], and in which lanes."""
    there, across, speeds, cosine = (field[..., -1] for field in rollouts[4:])
    along = (jnp.abs(cosine) > CROSSING) | (speeds < STANDING)
    inside = jnp.abs(across[:, None] - centres[..., None]) < WIDTH / 2 + 0.5
    return there, jnp.maximum(speeds * cosine, 0.0), inside & (along & scene.present)[:, None]


def _values(now: Situation, rollouts: Rollouts) -> Values:
    """Return minus the loss of speed that is left from each lane, place and speed after a plan [steps of speed].

    Places are as far apart as a step of speed goes in a second, so that all ways lead from place to place.
    """
    scene, fastest = now.scene, jnp.asarray(now.planning.desired_speed, float)
    step = fastest / (SPEEDS - 1)
    places, speeds = step * jnp.arange(PLACES), step * jnp.arange(SPEEDS)
    centres = WIDTH * jnp.arange(-AROUND, AROUND + 1.0)
    left, right = interpolate(scene.edges, places)
    there = (centres[:, None] > left + WIDTH / 4) & (centres[:, None] < right - WIDTH / 4)
    there = there.at[AROUND].set(True)
    traffic = _traffic(scene, rollouts, jnp.tile(centres, (len(rollouts.s), 1)))
    s, onward, inside = (jnp.median(field, axis=0) for field in traffic)
    reach, seconds = scene.reach[:, 0], jnp.arange(SECONDS_AFTER + 1)
    ahead = (s + onward * seconds[:, None])[:, None, None] - places[:, None]  # [seconds, 1, places, traffic]
    ahead = jnp.where((inside > 0.5)[:, None] & (ahead > -reach - ROOM_BEHIND), ahead - reach, FAR)
    nearest = jnp.argmin(ahead, axis=-1)
    gap = jnp.take_along_axis(ahead, nearest[..., None], axis=-1)
    closing = jnp.maximum(speeds - onward[nearest][..., None], 0.0)
    free = gap > ROOM_AHEAD + REACTION * speeds + closing**2 / (2 * GENTLE)  # [seconds, lanes, places, speeds]
    loss = jnp.maximum(jnp.minimum(interpolate(now.caps, places), fastest)[:, None] / step - jnp.arange(SPEEDS), 0.0)
    hindered = jnp.where(free & there[..., None], 0.0, BLOCKED)

    def back(value: Values, after: tuple[Values, Values]) -> tuple[Values, None]:
        """Return the values a second earlier: the best change of speed, then of lane into one that is free already."""
        value = jnp.pad(value - after[1] - loss, ((0, 0), (0, SPEEDS), (0, 0)), mode="edge")
        value = jnp.stack([value[:, speed : speed + PLACES, speed] for speed in range(SPEEDS)], axis=-1)
        value = jnp.pad(value, ((0, 0), (0, 0), (BRAKING, SPEEDING)), constant_values=-FAR)
        value = jnp.stack([value[..., change : change + SPEEDS] for change in range(BRAKING + SPEEDING + 1)]).max(
            axis=0
        )
        aside = jnp.pad(value - after[0] - CHANGE, ((1, 1), (0, 0), (0, 0)), constant_values=-FAR)
        return jnp.maximum(value, jnp.maximum(aside[:-2], aside[2:])), None

    return jax.lax.scan(back, jnp.zeros(hindered.shape[1:]), (hindered[:-1], hindered[1:]), reverse=True)[0]
