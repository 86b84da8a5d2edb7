"""Judge what follows a plan: room to stop, the speed that the lanes allow, and the way to the goal's lane."""

from functools import reduce

import jax
from jax import numpy as jnp
from jax.scipy.ndimage import map_coordinates

from ms_highway.geometry.curve import Knots, interpolate
from ms_highway.planning.car_following import FAR
from ms_highway.road.arrays import EachCar, EachFlag, Lane, Plans, Values
from ms_highway.road.constants import LANE, STOPPING
from ms_highway.road.proposals import DrivenPlans
from ms_highway.road.scene import RoadScene
from ms_highway.road.traffic import CROSSING, SAME_WAY, STANDING, Situation
from ms_highway.runtime.arrays import Numbers, Scalar

AROUND = 2  # lanes to each side of the robot's that it may use after a plan
SECONDS_AFTER = 8  # s, of what follows a plan
PLACES, SPEEDS = 144, 13  # of the table of what follows
SLOWER_FASTER = 2, 1  # steps of speed in a second at most
BLOCKED, CHANGE = 30.0, 0.3  # steps of speed that a second in the way of others and a change of lane count
SECONDS_TO_CLOSE_UP, KEPT = 3.0, 5.0  # s, m, of who limits the speed
ROOM_BEHIND, ROOM_AHEAD, GENTLE = 3.0, 1.0, 2.5  # m, m, m/s^2: to others after a plan
ROOM_BEHIND_SECONDS = 0.3  # s, at the desired speed: in jams, others follow more closely
SECONDS_AWAY = 1.0  # s, by which the robot has left the lane of who comes before they are there
REACTION, LEAST_GAP = 0.2, 0.2  # s
DISTURBED = 25.0  # m, to a car that joins, up to which others may change lanes for it
SLOWING_DOWN = 2.0  # m/s^2, with which a car ahead may brake
SECONDS_PER_CHANGE = 2.0  # s, that a change of lane may take


def lane_of(values: Knots, lanes: Lane, s: Numbers) -> Numbers:
    """Interpolate values that each lane has at the knots of the route, for plans that go to one lane each."""
    return jax.vmap(lambda lane, s: interpolate(values[lane], s))(lanes, s)


def urgency(scene: RoadScene, lanes: Lane) -> Plans:
    """Return the number of changes of lane that are left from each lane, less where there is room for them."""
    left = jnp.abs(scene.changes)
    needed = left * jnp.maximum(scene.robot[3], 8.0) * SECONDS_PER_CHANGE
    return (left * jnp.exp(-jnp.maximum(scene.room - needed, 0.0) / 40.0))[lanes]


def missing_room(now: Situation, driven: DrivenPlans, goal: Plans) -> EachCar:
    """Return what is missing to stop behind each car ahead after a plan, or to the least gap within it [m].

    A car that joins the road, and those near it, may change to the next lane at once, without looking. Ignore gap
    violations that exist at the start, and static obstacles: there is no gap to keep.
    """
    scene, (s, d, _, speed) = now.scene, driven.robot
    reach, apart = scene.reach[:, 0], scene.reach[:, 1] + 0.2
    gap = driven.s - s - scene.size[0] / 2
    led = (gap > 0) & (jnp.abs(driven.d - d) < apart[:, None]) & (driven.cosine > SAME_WAY)
    led = led & (scene.present & scene.moving)[:, None]
    close = jnp.where(led, jnp.maximum(LEAST_GAP * speed + reach[:, None] - gap, 0.0), 0.0)

    s, d, speed = s[..., -1], d[..., -1], speed[..., -1]
    there, across, speeds, cosine = (field[..., -1] for field in driven[4:])
    left, right = interpolate(scene.edges, driven.s[..., 0])
    joins = ((driven.d[..., 0] < left) | (driven.d[..., 0] > right)) & (cosine > SAME_WAY) & scene.present
    disturbed = (joins[:, None] & (jnp.abs(there[:, :, None] - there[:, None]) < DISTURBED)).any(axis=-1)
    beside, middle = jnp.where(disturbed, LANE, 0.0), s + scene.size[0] / 2
    low, high = jnp.minimum(goal[:, None], d) - apart - beside, jnp.maximum(goal[:, None], d) + apart + beside
    front = (there > middle) & (across > low) & (across < high) & scene.present
    onward = speeds * cosine
    counts = front & ((cosine > CROSSING) | (speeds < STANDING)) & (onward < speed)
    closing = jnp.maximum(speed - onward, 0.0)
    needed = 1.0 + REACTION * speed + closing**2 / (2 * (STOPPING * now.planning.grip - SLOWING_DOWN))
    missing = jnp.where(counts, jnp.maximum(needed - there + middle + reach, 0.0), 0.0)
    return jnp.maximum(missing, jnp.maximum(close.max(axis=-1) - close[..., 0], 0.0))


def prospects(now: Situation, driven: DrivenPlans, lanes: Lane) -> tuple[Plans, EachFlag]:
    """Return the mean loss of speed in the seconds after each plan [m/s], and who of the others limits it first.

    Plans end in lanes 0 to 2. All go on as points in their lanes, the others at the speed that they have then in the
    median of all plans. The robot drives as well as it can: dynamic programming over lanes, places and speeds.
    """
    scene, fastest = now.scene, jnp.asarray(now.planning.desired_speed, float)
    s, speed, step = driven.states[:, -1, 0] + scene.size[0] / 2, driven.states[:, -1, 3], fastest / (SPEEDS - 1)
    place, pace = jnp.clip(s / step, 0.0, PLACES - 1.01), jnp.clip(speed / step, 0.0, SPEEDS - 1.01)
    lost = -map_coordinates(_values(now, driven, step), [lanes + AROUND - 1, place, pace], order=1)
    there, onward, inside = _others(scene, driven, lane_of(scene.lanes, lanes, s)[:, None])
    gap = there - s[:, None]
    allowed = onward + jnp.maximum(gap - scene.reach[:, 0] - KEPT, 0.0) / SECONDS_TO_CLOSE_UP
    allowed = jnp.where(inside[:, 0] & (gap > 0), allowed, FAR)
    first = (allowed == allowed.min(axis=-1, keepdims=True)) & (allowed < fastest)
    return lost * step / SECONDS_AFTER, first


def _others(scene: RoadScene, driven: DrivenPlans, centres: Plans) -> tuple[EachCar, EachCar, EachFlag]:
    """Return where others are after each plan [m], how fast they go along the route [m/s], and in which lanes."""
    there, across, speeds, cosine = (field[..., -1] for field in driven[4:])
    along = (jnp.abs(cosine) > CROSSING) | (speeds < STANDING)
    inside = jnp.abs(across[:, None] - centres[..., None]) < LANE / 2 + 0.5
    return there, speeds * cosine, inside & (along & scene.present)[:, None]


def _values(now: Situation, driven: DrivenPlans, step: Scalar) -> Values:
    """Return minus the loss of speed that is left from each lane, place and speed after a plan [steps of speed].

    Places are as far apart as a step of speed goes in a second, so that all ways lead from place to place.
    """
    scene, fastest = now.scene, now.planning.desired_speed
    places, speeds = step * jnp.arange(PLACES), step * jnp.arange(SPEEDS)
    centres = LANE * jnp.arange(-AROUND, AROUND + 1.0)
    left, right = interpolate(scene.edges, places)
    there = (centres[:, None] > left + LANE / 4) & (centres[:, None] < right - LANE / 4)
    there = there.at[AROUND].set(True)
    traffic = _others(scene, driven, jnp.tile(centres, (len(driven.s), 1)))
    s, onward, inside = (jnp.median(field, axis=0) for field in traffic)
    reach, seconds = scene.reach[:, 0], jnp.arange(SECONDS_AFTER + 1)
    ahead = (s + onward * seconds[:, None])[:, None, None] - places[:, None]  # [seconds, 1, places, traffic]
    room_behind = jnp.minimum(ROOM_BEHIND, ROOM_BEHIND_SECONDS * fastest)
    ahead = jnp.where((inside > 0.5)[:, None] & (ahead > -reach - room_behind), ahead - reach, FAR)
    free = ahead.min(axis=-1, keepdims=True)
    onward = jnp.where(ahead == free, onward, FAR).min(axis=-1, keepdims=True)  # of whoever is next
    closing = jnp.maximum(speeds - jnp.maximum(onward, 0.0), 0.0)
    coming = SECONDS_AWAY * jnp.maximum(-onward, 0.0)
    needed = ROOM_AHEAD + REACTION * speeds + coming + closing**2 / (2 * GENTLE)  # [seconds, lanes, places, speeds]
    loss = jnp.maximum(jnp.minimum(interpolate(now.caps, places), fastest)[:, None] / step - jnp.arange(SPEEDS), 0.0)
    hindered = jnp.where((free > needed) & there[..., None], 0.0, BLOCKED)

    def back(value: Values, after: tuple[Values, Values]) -> tuple[Values, None]:
        """Return the values a second earlier: the best change of speed, then of lane into one that is free already."""
        value = jnp.pad(value - after[1] - loss, ((0, 0), (0, SPEEDS), (0, 0)), mode="edge")
        value = jnp.stack([value[:, speed : speed + PLACES, speed] for speed in range(SPEEDS)], axis=-1)
        value = jnp.pad(value, ((0, 0), (0, 0), SLOWER_FASTER), constant_values=-jnp.inf)
        value = reduce(jnp.maximum, (value[..., change : change + SPEEDS] for change in range(sum(SLOWER_FASTER) + 1)))
        aside = jnp.pad(value - after[0] - CHANGE, ((1, 1), (0, 0), (0, 0)), constant_values=-FAR)
        return jnp.maximum(value, jnp.maximum(aside[:-2], aside[2:])), None

    return jax.lax.scan(back, jnp.zeros(hindered.shape[1:]), (hindered[:-1], hindered[1:]), reverse=True)[0]
