"""Judge proposals and refined plans: what they earn, and which constraints they break."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.road import BEHIND, SPACING, RoadScene, interpolate
from ms_highway.planning.road.motion import bodies
from ms_highway.planning.road.proposals import Rollouts
from ms_highway.planning.road.settings import RoadPlanning
from ms_highway.planning.road.traffic import Ways, positions
from ms_highway.runtime.arrays import Array

__all__ = ["RoadWeights", "Scores", "score", "separation"]

FAR = 1e3  # m
WIDTH = 4.0  # m, of lanes
SIDE_LANES = np.arange(-2.0, 3.0, dtype=np.float32)  # to the right of the one that a plan ends in
SECONDS_AFTER = 8  # s, of what follows a plan
SECONDS_TO_CLOSE_UP, KEPT, CHANGING = 3.0, 5.0, 0.7  # s, m, m/s: see `_prospects`
ROOM_BEHIND, ROOM_AHEAD = 5.0, 3.0  # m, that a change of lane needs
MARGIN = 0.35  # m between bodies that counts as a collision
FADING = 0.95  # of what is expected later, per step
TOLERATED = 1.5  # m/s^2, of braking of others that costs nothing
REACTION = 0.2  # s
SLOWING_DOWN = 2.0  # m/s^2, with which a car ahead may brake
CROSSING = 0.5  # cosine of the angle up to which cars cross the robot's way rather than share it
STANDING = 1.0  # m/s
SHARED = 0.85  # cosine of the angle from which cars share a lane
CORRIDOR, CLEARANCE = 3.0, 1.0  # m, of the robot's way to each side, and around where others cross it
AWAITED = 6.0  # s, in which a crossing car has to come to count
STOPPING = 0.9  # share of the grip that a full stop may take
SECONDS_PER_CHANGE = 2.0  # s, that a change of lane may take


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadWeights:
    """What a plan is worth, per second unless told otherwise.

    Attributes:
        speed: of the share of the desired speed that is reached.
        prospect: of the share that the car ahead allows after the plan [for the whole plan].
        centre: of the squared distance to the centre of the lane [1/m^2].
        change: of leaving the lane, once [for the whole plan].
        right: of each lane further to the right [for the whole plan].
        goal: of each change of lane that is left to the goal, where the room for it is short [for the whole plan].
        acceleration: of squared acceleration [s^4/m^2].
        jerk: of squared jerk [s^6/m^2].
        imposed: of the squared braking that cars behind are made to do [s^4/m^2].
        near: of being nearer than `comfortable` to others, squared share.
        comfortable: distance between bodies [m].
        collision: of hitting somebody at once; less, the later [for the whole plan].
        blocking: of being in the way of a car that crosses, after a plan [for the whole plan].
        off_road: of leaving the road or an open lane [for the whole plan].
        stopping: of each metre that is missing to stop behind the car ahead [1/m, for the whole plan].
    """

    speed: float | Float[Array, ""] = 1.0
    prospect: float | Float[Array, ""] = 6.0
    centre: float | Float[Array, ""] = 0.005
    change: float | Float[Array, ""] = 0.1
    right: float | Float[Array, ""] = 0.1
    goal: float | Float[Array, ""] = 6.0
    acceleration: float | Float[Array, ""] = 0.01
    jerk: float | Float[Array, ""] = 0.002
    imposed: float | Float[Array, ""] = 0.3
    near: float | Float[Array, ""] = 8.0
    comfortable: float | Float[Array, ""] = 1.0
    collision: float | Float[Array, ""] = 100.0
    blocking: float | Float[Array, ""] = 40.0
    off_road: float | Float[Array, ""] = 200.0
    stopping: float | Float[Array, ""] = 1.0


class Scores(NamedTuple):
    """What plans earn.

    Attributes:
        own: without others.
        others: cost of each of the others.
        collides: whether a plan hits somebody.
        leaves: whether it leaves the road.
        missing: metres that are missing to stop behind the car ahead, after the plan.
    """

    own: Float[jax.Array, "plans"]
    others: Float[jax.Array, "plans traffic"]
    collides: Bool[jax.Array, "plans"]
    leaves: Bool[jax.Array, "plans"]
    missing: Float[jax.Array, "plans"]

    @property
    def total(self) -> Float[jax.Array, "plans"]:
        """What each plan earns in all."""
        return self.own - self.others.sum(axis=-1)

    @property
    def broken(self) -> Bool[jax.Array, "plans"]:
        """Whether a plan breaks a constraint."""
        return self.collides | self.leaves | (self.missing > 0)


def separation(
    own: tuple[jax.Array, jax.Array, jax.Array],
    size: Float[Array, "2"],
    other: tuple[jax.Array, jax.Array, jax.Array],
    sizes: Float[jax.Array, "*shape 2"],
) -> Float[jax.Array, "*shape"]:
    """Return the distance between two rectangles along the axis that separates them best [m]; negative if they overlap.

    Args:
        own: x, y and heading of one.
        size: its length and width [m].
        other: x, y and heading of the other.
        sizes: its length and width [m].
    """
    dx, dy, turn = other[0] - own[0], other[1] - own[1], other[2] - own[2]
    c, s = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
    (a, b), (e, f) = (size[0] / 2, size[1] / 2), (sizes[..., 0] / 2, sizes[..., 1] / 2)

    def along(heading: jax.Array) -> tuple[jax.Array, jax.Array]:
        cosine, sine = jnp.cos(heading), jnp.sin(heading)
        return jnp.abs(dx * cosine + dy * sine), jnp.abs(dy * cosine - dx * sine)

    (u, v), (p, q) = along(own[2]), along(other[2])
    gaps = u - a - e * c - f * s, v - b - e * s - f * c, p - e - a * c - b * s, q - f - a * s - b * c
    return jnp.maximum(jnp.maximum(gaps[0], gaps[1]), jnp.maximum(gaps[2], gaps[3]))


def score(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadWeights,
    ways: Ways,
    rollouts: Rollouts,
    lanes: Int[jax.Array, "plans"],
    caps: Float[jax.Array, "knots"],
) -> Scores:
    """Judge plans.

    Args:
        scene: the road.
        planning: limits and wishes.
        weights: what counts.
        ways: see `ms_highway.planning.road.traffic.ways_of`.
        rollouts: of the plans.
        lanes: that each goes to, 0 to 2.
        caps: see `ms_highway.planning.road.proposals.speed_caps`.
    """
    dt, states, controls = planning.time_step, rollouts.states, rollouts.controls
    s, d, heading, speed = jnp.moveaxis(states, -1, 0)
    wanted = jnp.minimum(interpolate(caps, s), planning.desired_speed)
    reached = 1 - jnp.abs(speed - wanted) / planning.desired_speed
    centres = jnp.asarray(scene.lanes)
    goal = jax.vmap(lambda lane, s: interpolate(centres[lane], s))(lanes, s)
    before = jnp.concatenate([jnp.full_like(speed[:, :1], scene.robot[3]), speed[:, :-1]], axis=1)
    lateral = before**2 * controls[..., 0]
    sideways = jnp.concatenate([jnp.full_like(lateral[:, :1], scene.robot[3] ** 2 * scene.applied[0]), lateral], axis=1)
    pushed = jnp.concatenate([jnp.full_like(lateral[:, :1], scene.applied[1]), controls[..., 1]], axis=1)
    jerk = (jnp.diff(sideways, axis=1) ** 2 + jnp.diff(pushed, axis=1) ** 2) / dt**2
    per_second = (
        weights.speed * reached
        - weights.centre * (d - goal) ** 2
        - weights.acceleration * (controls[..., 1] ** 2 + (lateral - before**2 * _bend(scene, s)) ** 2)
        - weights.jerk * jerk
    )
    x, y, course = bodies(scene, states)
    left, right = (interpolate(jnp.asarray(scene.edges)[side], s + scene.size[0] / 2) for side in range(2))
    middle = d + scene.size[0] / 2 * jnp.sin(heading)
    reach = (scene.size[1] * jnp.cos(heading) + scene.size[0] * jnp.abs(jnp.sin(heading))) / 2
    beyond = jnp.maximum(jnp.maximum(left - middle + reach, middle + reach - right), 0.0)
    already = jnp.maximum(beyond[:, :1], 0.0)  # what cannot be helped any more does not count
    leaves = (beyond > already + 0.1).any(axis=1)
    opened = jax.vmap(lambda lane, s: interpolate(jnp.asarray(scene.open, float)[lane], s))(lanes, s[:, -1])
    closed = (opened < 0.5) & (lanes != 1)
    per_plan = (
        weights.right * (lanes - 1.0)
        - weights.change * (lanes != 1)
        - weights.goal * _urgency(scene, planning, lanes)
        - weights.off_road * (leaves | closed)
    )
    clear = separation(
        (x[:, None], y[:, None], course[:, None]),
        scene.size,
        jax.vmap(lambda a, b: jnp.stack(positions(scene, a, b)))(rollouts.along, rollouts.across).swapaxes(0, 1),
        jnp.asarray(scene.sizes)[:, None],
    )
    counts = jnp.asarray(scene.present)[:, None] & ~_pushes_from_behind(scene, rollouts, s, d, lanes)
    clear = jnp.where(counts, clear, FAR)
    hit, fading = clear < MARGIN, FADING ** jnp.arange(planning.steps)
    near = jnp.maximum(1 - jnp.maximum(clear, 0.0) / weights.comfortable, 0.0) ** 2
    closeness = dt * weights.near * jnp.sum(near * fading, axis=-1)
    speeds = rollouts.speeds
    first = jnp.broadcast_to(jnp.asarray(scene.states)[:, 3:], (*speeds.shape[:-1], 1))
    slowed = jnp.diff(speeds, axis=-1, prepend=first) / dt
    imposed = jnp.where(rollouts.s < s[:, None], jnp.maximum(-slowed - TOLERATED, 0.0), 0.0)
    closeness = closeness + dt * weights.imposed * jnp.sum(imposed**2, axis=-1)
    others = closeness + weights.collision * jnp.max(jnp.where(hit, fading, 0.0), axis=-1)
    missing = _missing(scene, planning, rollouts, goal[:, -1])
    limit = jnp.minimum(wanted[:, -1], planning.desired_speed)
    prospect, charged = _prospects(scene, rollouts, goal[:, -1], limit)
    lost = weights.prospect * (1 - prospect / limit)
    per_plan = per_plan - jnp.where(charged.any(axis=-1), 0.0, lost)
    others = others + weights.stopping * missing + jnp.where(charged, lost[:, None], 0.0)
    others = others + weights.blocking * _blocks(scene, ways, rollouts)
    own = dt * per_second.sum(axis=1) + per_plan
    return Scores(own, others, hit.any(axis=(1, 2)), leaves | closed, missing.max(axis=1))


def _bend(scene: RoadScene, s: jax.Array) -> jax.Array:
    return interpolate(scene.route.curvature, s)


def _urgency(scene: RoadScene, planning: RoadPlanning, lanes: jax.Array) -> jax.Array:
    """Return the number of changes of lane that are left from each lane, less where there is room for them."""
    left = jnp.abs(jnp.asarray(scene.changes))
    needed = left * jnp.maximum(scene.robot[3], 8.0) * SECONDS_PER_CHANGE
    return (left * jnp.exp(-jnp.maximum(scene.room - needed, 0.0) / 40.0))[lanes]


def _pushes_from_behind(
    scene: RoadScene, rollouts: Rollouts, s: jax.Array, d: jax.Array, lanes: jax.Array
) -> Bool[jax.Array, "plans traffic steps"]:
    """Return where a follower in the robot's own lane would run into it while it keeps its lane."""
    behind = rollouts.s < s[:, None] - 1.0
    mine = jnp.abs(rollouts.d - d[:, None]) < scene.size[1]
    follower = behind[..., :1] & mine[..., :1] & (rollouts.cosine > 0.5)
    return follower & behind & (lanes == 1)[:, None, None]


def _missing(
    scene: RoadScene, planning: RoadPlanning, rollouts: Rollouts, goal: Float[jax.Array, "plans"]
) -> Float[jax.Array, "plans traffic"]:
    """Return what is missing to stop behind each car ahead after a plan [m]."""
    s, d, _, speed = jnp.moveaxis(rollouts.states[:, -1], -1, 0)
    there, across, cosine = rollouts.s[..., -1], rollouts.d[..., -1], rollouts.cosine[..., -1]
    apart = (scene.size[1] + jnp.asarray(scene.sizes)[:, 1]) / 2 + 0.2
    middle = (s + scene.size[0] / 2)[:, None]
    low, high = jnp.minimum(goal, d)[:, None] - apart, jnp.maximum(goal, d)[:, None] + apart
    front = (there > middle) & (across > low) & (across < high) & jnp.asarray(scene.present)
    front = front & ((jnp.abs(cosine) > CROSSING) | (rollouts.speeds[..., -1] < STANDING))
    gap = there - middle - (scene.size[0] + jnp.asarray(scene.sizes)[:, 0]) / 2
    onward = rollouts.speeds[..., -1] * cosine
    closing = jnp.maximum(speed[:, None] - onward, 0.0)
    needed = 1.0 + REACTION * speed[:, None] + closing**2 / (2 * (STOPPING * planning.grip - SLOWING_DOWN))
    return jnp.where(front & (onward < speed[:, None]), jnp.maximum(needed - gap, 0.0), 0.0)


def _blocks(scene: RoadScene, ways: Ways, rollouts: Rollouts) -> Bool[jax.Array, "plans traffic"]:
    """Return whether the robot, after a plan, is still where a car crosses its route when that car comes.

    The robot goes on as fast as it is then, and faster; the car at its speed.
    """
    crossed = (jnp.abs(ways.d) < CORRIDOR) & (jnp.abs(ways.cosine) < SHARED)  # [traffic, knots]
    knots = SPACING * jnp.arange(ways.s.shape[-1]) - BEHIND
    low, first = (jnp.where(crossed, values, FAR).min(axis=-1) for values in (ways.s, knots))
    high = jnp.where(crossed, ways.s, -FAR).max(axis=-1)
    s, speed = rollouts.states[:, -1, 0, None], rollouts.states[:, -1, 3, None]
    entered = (s + scene.size[0] > low - CLEARANCE) & (s < high + CLEARANCE)
    leaving = (high + CLEARANCE - s) / (speed + 1.0)
    lengths = jnp.asarray(scene.sizes)[:, 0]
    coming = (first - lengths - rollouts.along[..., -1]) / jnp.maximum(rollouts.speeds[..., -1], 1.0)
    still = rollouts.along[..., -1] < jnp.where(crossed, knots, -FAR).max(axis=-1)
    moving = jnp.asarray(scene.present) & jnp.asarray(scene.moving)
    return entered & still & moving & (coming < leaving + 0.5) & (coming < AWAITED)


def _prospects(
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

    def go(carry: tuple[jax.Array, ...], number: jax.Array) -> tuple[tuple[jax.Array, ...], jax.Array]:
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
