"""Judge proposals and refined plans: what they earn, and which constraints they break."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.road import RoadScene, interpolate
from ms_highway.planning.road.junctions import avoidable, blocks, occupied
from ms_highway.planning.road.motion import bodies
from ms_highway.planning.road.proposals import Rollouts
from ms_highway.planning.road.prospects import missing_room, prospects, pushes_from_behind, urgency
from ms_highway.planning.road.settings import RoadPlanning
from ms_highway.planning.road.traffic import FAR, Ways, on_route, positions
from ms_highway.runtime.arrays import Array

__all__ = ["RoadWeights", "Scores", "score", "separation"]

MARGIN = 0.35  # m between bodies that counts as a collision
FADING = 0.95  # of what is expected later, per step
TOLERATED = 1.5  # m/s^2, of braking of others that costs nothing
SOON = 1.6  # s, until when all counts that others may do


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
        avoidable: share that counts of what can still be avoided by stopping before a crossing.
        off_road: of leaving the road, and of a lane that is not open [for the whole plan].
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
    avoidable: float | Float[Array, ""] = 0.02
    off_road: float | Float[Array, ""] = 200.0
    stopping: float | Float[Array, ""] = 1.0


class Scores(NamedTuple):
    """What plans earn.

    Attributes:
        own: without others.
        others: cost of each of the others.
        answerable: the part of it that may change if a car answers the robot: not that of cars ahead of it in its lane,
            and not what happens after the plan.
        collides: whether a plan comes too close to somebody.
        impact: highest difference of velocities at which it hits somebody for good [m/s]; 0 if it does not.
        leaves: whether it leaves the road.
        missing: metres that are missing to stop behind the car ahead, after the plan.
    """

    own: Float[jax.Array, "plans"]
    others: Float[jax.Array, "plans traffic"]
    answerable: Float[jax.Array, "plans traffic"]
    collides: Bool[jax.Array, "plans"]
    impact: Float[jax.Array, "plans"]
    leaves: Bool[jax.Array, "plans"]
    missing: Float[jax.Array, "plans"]

    @property
    def total(self) -> Float[jax.Array, "plans"]:
        """What each plan earns in all."""
        return self.own - self.others.sum(axis=-1)

    @property
    def preference(self) -> Float[jax.Array, "plans"]:
        """What plans are chosen by: what they earn; if all hit somebody, how softly they do."""
        return jnp.where((self.impact > 0).all(), -self.impact, self.total)

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
        - weights.goal * urgency(scene, planning, lanes)
        - weights.off_road * (leaves.astype(float) + closed)
    )
    own_bodies, bodies_of_others = (
        (x[:, None], y[:, None], course[:, None]),
        jax.vmap(partial(positions, scene))(rollouts.along, rollouts.across),
    )
    clear = separation(own_bodies, scene.size, bodies_of_others, occupied(scene, planning, rollouts))
    counts = jnp.asarray(scene.present)[:, None] & ~pushes_from_behind(scene, rollouts, s, d, lanes)
    clear = jnp.where(counts, clear, FAR)
    touch = counts & (separation(own_bodies, scene.size, bodies_of_others, jnp.asarray(scene.sizes)[:, None]) < 0)
    impact = _impact(touch, speed[:, None], course[:, None], rollouts.speeds, bodies_of_others[2])
    hit, fading = clear < MARGIN, FADING ** jnp.arange(planning.steps)
    later = dt * jnp.arange(planning.steps) > SOON
    revised = avoidable(scene, ways, rollouts)[..., None]
    fading = fading * jnp.where(revised & later, weights.avoidable, 1.0)
    near = jnp.maximum(1 - jnp.maximum(clear, 0.0) / weights.comfortable, 0.0) ** 2
    closeness = dt * weights.near * jnp.sum(near * fading, axis=-1)
    speeds = rollouts.speeds
    first = jnp.broadcast_to(jnp.asarray(scene.states)[:, 3:], (*speeds.shape[:-1], 1))
    slowed = jnp.diff(speeds, axis=-1, prepend=first) / dt
    endangered = (rollouts.s < s[:, None]) & (speeds > speed[:, None])  # behind a faster robot, gaps open by themselves
    imposed = jnp.where(endangered, jnp.maximum(-slowed - TOLERATED, 0.0), 0.0)
    closeness = closeness + dt * weights.imposed * jnp.sum(imposed**2, axis=-1)
    others = closeness + weights.collision * jnp.max(jnp.where(hit, fading, 0.0), axis=-1)
    crossing = weights.blocking * blocks(scene, ways, rollouts) * jnp.where(revised[..., 0], weights.avoidable, 1.0)
    others = others + crossing
    answerable = jnp.where(_leads(scene, ways), 0.0, others)
    missing = missing_room(scene, planning, rollouts, goal[:, -1])
    slower, charged = prospects(scene, planning, rollouts, lanes, caps)
    lost = weights.prospect * slower / planning.desired_speed
    per_plan = per_plan - jnp.where(charged.any(axis=-1), 0.0, lost)
    others = others + weights.stopping * missing + jnp.where(charged, lost[:, None], 0.0)
    own = dt * per_second.sum(axis=1) + per_plan
    return Scores(
        own, jnp.asarray(others), answerable, hit.any(axis=(1, 2)), impact, leaves | closed, missing.max(axis=1)
    )


def _impact(
    touch: Bool[jax.Array, "plans traffic steps"],
    speed: Float[jax.Array, "plans 1 steps"],
    course: Float[jax.Array, "plans 1 steps"],
    speeds: Float[jax.Array, "plans traffic steps"],
    courses: Float[jax.Array, "plans traffic steps"],
) -> Float[jax.Array, "plans"]:
    """Return the highest difference of velocities when bodies first touch [m/s]; 0 if they never do."""
    first = touch & (jnp.cumsum(touch, axis=-1) == 1)
    squared = speed**2 + speeds**2 - 2 * speed * speeds * jnp.cos(course - courses)
    return jnp.where(first, jnp.sqrt(jnp.maximum(squared, 1e-4)), 0.0).max(axis=(1, 2))


def _leads(scene: RoadScene, ways: Ways) -> Bool[jax.Array, "traffic"]:
    """Return who is ahead of the robot in its lane, and does not look back."""
    s, d, cosine = on_route(ways, jnp.asarray(scene.states)[:, 0], jnp.asarray(scene.states)[:, 1])
    return (s > scene.robot[0]) & (jnp.abs(d - scene.robot[1]) < scene.size[1]) & (cosine > 0.5)


def _bend(scene: RoadScene, s: jax.Array) -> jax.Array:
    return interpolate(scene.route.curvature, s)
