"""Judge proposals: what they earn, and which constraints they break."""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.geometry.bodies import separation
from ms_highway.geometry.curve import Pose, interpolate, rotated
from ms_highway.perception.scene import EachCar, EachFlag, EachStep, Lane, PlanFlags, Plans, World
from ms_highway.planning.car_following import FREE_GAP, highest, lowest
from ms_highway.road.constants import RoadWeights
from ms_highway.road.proposals import Profiles
from ms_highway.road.simulation import DrivenPlans, aim, earlier
from ms_highway.road.terminal_value import terminal_value
from ms_highway.road.traffic import CROSSING, SAME_WAY, STANDING_SPEED, Situation, lane_of
from ms_highway.runtime.arrays import Numbers


class Scores(NamedTuple):
    """What plans earn.

    Attributes:
        own: without others.
        others: cost of each of the others.
        answerable: the part of it that may change if a car answers the robot: not that of cars ahead of it in its lane,
            and not what happens after the plan.
        intrusion: depth in the margin around others [m]; at most that margin where nobody is hit.
        impact: relative speed at an unavoidable collision, the highest [m/s]; 0 without one.
        leaves: whether it leaves the road.
        missing: metres that are missing to stop behind the car ahead, after the plan.
    """

    own: Plans
    others: EachCar
    answerable: EachCar
    intrusion: Plans
    impact: Plans
    leaves: PlanFlags
    missing: Plans

    @property
    def total(self) -> Plans:
        """What each plan earns in all."""
        return self.own - self.others.sum(axis=-1)

    @property
    def preference(self) -> Plans:
        """What plans are chosen by: sound ones first, then those that hit nobody, then those that hit most softly."""
        faults = jnp.where(self.impact > 0, 2 + self.impact, self.broken + self.intrusion)
        return self.total - RoadWeights.unsound * (faults + RoadWeights.leaving * self.leaves)

    @property
    def collides(self) -> PlanFlags:
        """Whether a plan comes too close to somebody."""
        return self.intrusion > 0

    @property
    def broken(self) -> PlanFlags:
        """Whether a plan breaks a constraint."""
        return self.collides | self.leaves | (self.missing > 0)


def score(now: Situation, driven: DrivenPlans, plans: Profiles) -> Scores:
    """Judge plans."""
    lanes, scene, planning, weights = plans.lane, now.scene, now.planning, now.weights
    desired = planning.desired_speed
    s, d, _, speed = jnp.moveaxis(driven.states, -1, 0)
    goal = lane_of(scene.lanes, lanes, s)
    off_speed = jnp.abs(speed - jnp.minimum(interpolate(now.caps, s), desired))
    per_second = weights.speed * (1 - off_speed / desired) - weights.centre * (d - goal) ** 2 - _discomfort(now, driven)
    closed = (lane_of(scene.open.astype(float), lanes, s[:, -1]) < 0.5) & (lanes != 1)
    closed = closed | ((plans.side != 0) & ~now.obstruction.exists)  # nothing to go round
    leaves = _leaves(now, driven)
    off_road = weights.off_road * (leaves.astype(float) + closed)
    others, intrusion, impact = _collisions(now, driven, lanes)
    target = jax.vmap(aim, (None, 0, 0))(now, plans, s[:, -1])
    own, after, missing = terminal_value(now, driven, lanes, goal[:, -1], target)
    return Scores(
        own=planning.time_step * per_second.sum(axis=1) - off_road + own,
        others=others + after,
        answerable=jnp.where(now.leading, 0.0, others),
        intrusion=intrusion,
        impact=impact,
        leaves=leaves | closed,
        missing=missing.max(axis=1),
    )


def _discomfort(now: Situation, driven: DrivenPlans) -> EachStep:
    """Return the cost of acceleration and jerk after each step."""
    scene, weights, (curvature, acceleration) = now.scene, now.weights, jnp.moveaxis(driven.controls, -1, 0)
    squared = earlier(scene.robot[3], driven.states[..., 3]) ** 2
    lateral, bend = squared * curvature, interpolate(scene.route.curvature, driven.states[..., 0])
    jerk = jnp.diff(lateral, axis=1, prepend=scene.robot[3] ** 2 * scene.applied[0]) ** 2
    jerk = (jerk + jnp.diff(acceleration, axis=1, prepend=scene.applied[1]) ** 2) / now.planning.time_step**2
    return weights.acceleration * (acceleration**2 + (lateral - squared * bend) ** 2) + weights.jerk * jerk


def _leaves(now: Situation, driven: DrivenPlans) -> PlanFlags:
    """Return whether plans leave the road; what cannot be helped any more does not count."""
    (s, d, heading, _), (length, width) = jnp.moveaxis(driven.states, -1, 0), now.scene.size
    middle = d + length / 2 * jnp.sin(heading)
    reach = (width * jnp.cos(heading) + length * jnp.abs(jnp.sin(heading))) / 2
    left, right = interpolate(now.scene.edges, s + length / 2)
    beyond = jnp.maximum(jnp.maximum(left - middle + reach, middle + reach - right), 0.0)
    return (beyond > beyond[:, :1] + now.weights.off).any(axis=1)


def _collisions(now: Situation, driven: DrivenPlans, lanes: Lane) -> tuple[EachCar, Plans, Plans]:
    """Return what the nearness of others costs, how deep plans are in their margins, and the speed of impacts.

    Where a plan can still stop before a car's way once it has begun, what that car may do later costs less and breaks
    no constraint: the robot sees it come, and plans again. The impact is the highest relative speed when bodies first
    touch.
    """
    scene, planning, weights, speeds = now.scene, now.planning, now.weights, driven.speeds
    dt, steps, (s, d, _, speed) = planning.time_step, jnp.arange(planning.steps), driven.robot
    own, others = _pose(driven.path[:, None]), _pose(driven.world)
    # A follower in the robot's own lane that runs into it, or through it, while it is in its lane does not count.
    behind = driven.s[..., :1] < s[..., :1] - 1.0
    followed = steps < _first(jnp.abs(driven.d - d) >= scene.size[1])
    stays = jnp.equal(lanes, 1)[:, None, None] | (steps < _first(jnp.abs(d - scene.robot[1]) >= weights.begun))
    counts = scene.present[:, None] & ~(behind & followed & (driven.cosine > CROSSING) & stays)
    clear = jnp.where(counts, separation(own, scene.size, others, _occupied(now, driven)), FREE_GAP)
    touch = counts & (separation(own, scene.size, others, scene.sizes[:, None]) < 0)
    onward, sideways = rotated(speeds * jnp.cos(others[2]), speeds * jnp.sin(others[2]), own[2])
    relative = jnp.sqrt(jnp.maximum((speed - onward) ** 2 + sideways**2, 1e-4))
    avoidable = _avoidable(now, driven)
    binds = ~(avoidable[..., None] & (dt * steps > weights.soon))
    fading = weights.fading**steps * jnp.where(binds, 1.0, weights.avoidable)
    near = jnp.clip(1 - clear / weights.comfortable, 0.0, 1.0) ** 2
    slowed = jnp.diff(speeds, axis=-1, prepend=jnp.broadcast_to(scene.states[:, 3:], (*speeds.shape[:-1], 1))) / dt
    endangered = (driven.s < s) & (speeds > speed)  # behind a faster robot, gaps open by themselves
    imposed = jnp.where(endangered, jnp.maximum(-slowed - weights.tolerated, 0.0), 0.0)
    depth = jnp.where(scene.moving, weights.margin, weights.wreck_margin)[:, None] - clear
    cost = (
        dt * weights.near * jnp.sum(near * fading, axis=-1)
        + dt * weights.imposed * jnp.sum(imposed**2, axis=-1)
        + weights.collision * jnp.max(jnp.where(depth > 0, fading, 0.0), axis=-1)
        + weights.blocking * blocks(now, driven) * jnp.where(avoidable, weights.avoidable, 1.0)
    )
    impact = jnp.where((steps == _first(touch)) & binds, relative, 0.0).max(axis=(1, 2))
    return cost, jnp.where(binds, jnp.maximum(depth, 0.0), 0.0).max(axis=(1, 2)), impact


def _pose(world: World) -> Pose:
    x, y, heading, _ = jnp.moveaxis(world, -2, 0)
    return x, y, heading


def _first(happens: Numbers) -> Numbers:
    """Return the number of the first step in which something happens, that after the last where nothing does."""
    steps = happens.shape[-1]
    return jnp.where(happens, jnp.arange(steps), steps).min(axis=-1, keepdims=True)


def _occupied(now: Situation, driven: DrivenPlans) -> EachStep:
    """Return length and width of what others may occupy [m]: more of their way where it crosses the robot's.

    Nobody knows when exactly a car comes that may brake or speed up; where it is now is known.
    """
    weights, times = now.weights, now.planning.times
    early = jnp.minimum(weights.early * driven.speeds + 0.5, weights.unsure * times**2 / 2)
    early = jnp.where((driven.cosine < SAME_WAY) & (driven.speeds > STANDING_SPEED), early, 0.0)
    lengths, widths = now.scene.sizes.T[..., None]
    return jnp.stack([lengths + 2 * early, jnp.broadcast_to(widths, early.shape)], axis=-1)


def _avoidable(now: Situation, driven: DrivenPlans) -> EachFlag:
    """Return whether the robot can still stop before where a car crosses its route, soon after a plan has begun."""
    s, _, _, speed = driven.robot[..., now.weights.decided]
    left = now.crossings.line - s - now.scene.size[0]
    return now.crossings.exist & (left > speed**2 / (2 * now.planning.stopping * now.planning.grip))


def blocks(now: Situation, driven: DrivenPlans) -> EachFlag:
    """Return whether the robot, after a plan, is still where a car crosses its route when that car comes.

    The robot goes on as fast as it is then, and faster; the car at its speed. Oncoming cars in the robot's lane count
    in `ms_highway.road.terminal_value.speed_lost`.
    """
    scene, weights, ways, end = now.scene, now.weights, now.crossings, driven.end
    s, d, _, speed = driven.robot[..., -1]
    rear, front = s[..., None] - weights.clearance, s[..., None] + scene.size[0] + weights.clearance
    across = jnp.abs(ways.d - d[..., None]) < weights.corridor
    here = across & (ways.s > rear) & (ways.s < front)
    leaving = (highest(ways.s, across) + weights.clearance - s) / (speed + 1.0)
    coming = (lowest(ways.places, here) - scene.sizes[:, 0] - end.along) / jnp.maximum(end.speeds, 1.0)
    comes = end.along < highest(ways.places, here)
    return scene.moving & comes & (coming < leaving + weights.passed) & (coming < weights.awaited)
