"""Judge proposals: what they earn, and which constraints they break."""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.geometry.bodies import separation
from ms_highway.geometry.curve import Knots, interpolate, rotated
from ms_highway.planning.car_following import FAR, highest, lowest
from ms_highway.road.arrays import EachCar, EachFlag, EachStep, Lane, PlanFlags, Plans
from ms_highway.road.constants import LANE, STOPPING
from ms_highway.road.motion import bodies, earlier
from ms_highway.road.proposals import DrivenPlans, Profiles, aim
from ms_highway.road.prospects import lane_of, missing_room, prospects, urgency
from ms_highway.road.traffic import (
    CORRIDOR,
    CROSSING,
    SAME_WAY,
    STANDING,
    Situation,
    leads,
)
from ms_highway.runtime.arrays import Numbers

MARGIN = 0.35  # m between bodies that counts as a collision
MARGIN_TO_WRECKS = 0.6  # m, the same for what cannot move: plans are looked at every 0.2 s only
FADING = 0.95  # of what is expected later, per step
TOLERATED = 1.5  # m/s^2, of braking of others that costs nothing
SOON = 1.6  # s, until when all counts that others may do
EARLY = 0.08  # s, that cars which cross may come earlier or later
ASIDE = 0.5  # m, from where a robot that changes lanes is, up to which it has not begun
CLEARANCE = 1.0  # m, around where others cross the robot's way
UNSURE = 6.0  # m/s^2, of the accelerations that others may have
DECIDED = 1  # step after which stopping has to be possible
UNSOUND = 1e3  # more than plans earn or cost otherwise
LEAVING = 10.0  # m/s, of an impact that is as bad as to leave the road
AWAITED = 6.0  # s, in which a crossing car has to come to count


class Scores(NamedTuple):
    """What plans earn.

    Attributes:
        own: without others.
        others: cost of each of the others.
        answerable: the part of it that may change if a car answers the robot: not that of cars ahead of it in its lane,
            and not what happens after the plan.
        intrusion: depth in the margin around others [m]; at most that margin where nobody is hit.
        impact: highest difference of velocities at which it hits somebody for good [m/s]; 0 if it does not.
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
        return self.total - UNSOUND * (faults + LEAVING * self.leaves)

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
    per_second = weights.speed * (1 - off_speed / desired) - weights.centre * (d - goal) ** 2
    per_second = per_second - _discomfort(now, driven)
    closed = (lane_of(scene.open.astype(float), lanes, s[:, -1]) < 0.5) & (lanes != 1)
    closed = closed | ((plans.side != 0) & ~now.obstruction.exists)  # nothing to go round
    leaves = _leaves(now, driven, plans)
    share = jnp.where(lanes == 1, 1.0, jnp.clip(1 - jnp.abs(goal - d)[:, -1] / LANE, 0.0, 1.0))  # of its change of lane
    urgent = urgency(scene, 1)
    per_plan = (
        weights.right * share * (lanes - 1.0)
        - weights.change * (lanes != 1)
        - weights.goal * (urgent + share * (urgency(scene, lanes) - urgent))
        - weights.off_road * (leaves.astype(float) + closed)
    )
    others, intrusion, impact = _meetings(now, driven, lanes)
    missing = missing_room(now, driven, jax.vmap(aim, (None, 0, 0))(now, plans, s[:, -1]))
    slower, charged = prospects(now, driven, jnp.where(share > 0.5, lanes, 1))
    lost = weights.prospect * slower / desired
    return Scores(
        own=planning.time_step * per_second.sum(axis=1) + per_plan - jnp.where(charged.any(axis=-1), 0.0, lost),
        others=others + weights.stopping * missing + jnp.where(charged, lost[:, None], 0.0),
        answerable=jnp.where(leads(scene, now.ways, scene.size[1]), 0.0, others),
        intrusion=intrusion,
        impact=impact,
        leaves=leaves | closed,
        missing=missing.max(axis=1),
    )


def _discomfort(now: Situation, driven: DrivenPlans) -> EachStep:
    """Return the cost of acceleration and jerk after each step."""
    scene, weights, speed, controls = now.scene, now.weights, driven.states[..., 3], driven.controls
    squared = earlier(scene.robot[3], speed) ** 2
    lateral = squared * controls[..., 0]
    bend = interpolate(scene.route.curvature, driven.states[..., 0])
    jerk = jnp.diff(lateral, axis=1, prepend=scene.robot[3] ** 2 * scene.applied[0]) ** 2
    jerk = (jerk + jnp.diff(controls[..., 1], axis=1, prepend=scene.applied[1]) ** 2) / now.planning.time_step**2
    return weights.acceleration * (controls[..., 1] ** 2 + (lateral - squared * bend) ** 2) + weights.jerk * jerk


def _leaves(now: Situation, driven: DrivenPlans, plans: Profiles) -> PlanFlags:
    """Return whether plans leave the road.

    What lanes of others pave counts as road for plans that go round what cannot move, and for all plans of a robot that
    is beside its road on the way round. What cannot be helped any more does not count.
    """
    scene, (length, width) = now.scene, now.scene.size

    def beyond(edges: Knots, states: Numbers) -> Numbers:
        s, d, heading, _ = jnp.moveaxis(states, -1, 0)
        middle = d + length / 2 * jnp.sin(heading)
        reach = (width * jnp.cos(heading) + length * jnp.abs(jnp.sin(heading))) / 2
        left, right = interpolate(edges, s + length / 2)
        return jnp.maximum(jnp.maximum(left - middle + reach, middle + reach - right), 0.0)

    wide = now.obstruction.exists & ((plans.side != 0) | (beyond(scene.edges, scene.robot) > 0))
    found = jnp.where(wide[:, None], beyond(scene.paved, driven.states), beyond(scene.edges, driven.states))
    return (found > found[:, :1] + 0.1).any(axis=1)


def _meetings(now: Situation, driven: DrivenPlans, lanes: Lane) -> tuple[EachCar, Plans, Plans]:
    """Return what the nearness of others costs, how deep plans are in their margins, and how hard they hit somebody.

    Where a plan can still stop before a car's way once it has begun, what that car may do later costs less and breaks
    no constraint: the robot sees it come, and plans again. The impact is the highest difference of velocities when
    bodies first touch.
    """
    scene, planning, weights, speeds = now.scene, now.planning, now.weights, driven.speeds
    dt, steps, (s, d, _, speed) = planning.time_step, jnp.arange(planning.steps), driven.robot
    x, y, heading = jnp.moveaxis(driven.world[:, :, :3], 2, 0)
    own, others = bodies(scene, driven.states[:, None]), (x, y, heading)
    # A follower in the robot's own lane that runs into it, or through it, while it is in its lane does not count.
    behind = driven.s[..., :1] < s[..., :1] - 1.0
    followed = steps < _first(jnp.abs(driven.d - d) >= scene.size[1])
    stays = jnp.equal(lanes, 1)[:, None, None] | (steps < _first(jnp.abs(d - scene.robot[1]) >= ASIDE))
    pushes = behind & followed & (driven.cosine > CROSSING) & stays
    counts = scene.present[:, None] & ~pushes
    clear = jnp.where(counts, separation(own, scene.size, others, _occupied(now, driven)), FAR)
    touch = counts & (separation(own, scene.size, others, scene.sizes[:, None]) < 0)
    first = steps == _first(touch)
    onward, sideways = rotated(speeds * jnp.cos(heading), speeds * jnp.sin(heading), own[2])
    squared = (speed - onward) ** 2 + sideways**2  # of the difference of velocities
    revised = _avoidable(now, driven)[..., None]
    binds = ~(revised & (dt * steps > SOON))
    fading = FADING**steps * jnp.where(binds, 1.0, weights.avoidable)
    near = jnp.clip(1 - clear / weights.comfortable, 0.0, 1.0) ** 2
    slowed = jnp.diff(speeds, axis=-1, prepend=jnp.broadcast_to(scene.states[:, 3:], (*speeds.shape[:-1], 1))) / dt
    endangered = (driven.s < s) & (speeds > speed)  # behind a faster robot, gaps open by themselves
    imposed = jnp.where(endangered, jnp.maximum(-slowed - TOLERATED, 0.0), 0.0)
    depth = jnp.where(scene.moving, MARGIN, MARGIN_TO_WRECKS)[:, None] - clear
    cost = (
        dt * weights.near * jnp.sum(near * fading, axis=-1)
        + dt * weights.imposed * jnp.sum(imposed**2, axis=-1)
        + weights.collision * jnp.max(jnp.where(depth > 0, fading, 0.0), axis=-1)
        + weights.blocking * blocks(now, driven) * jnp.where(revised[..., 0], weights.avoidable, 1.0)
    )
    impact = jnp.where(first & binds, jnp.sqrt(jnp.maximum(squared, 1e-4)), 0.0).max(axis=(1, 2))
    return cost, jnp.where(binds, jnp.maximum(depth, 0.0), 0.0).max(axis=(1, 2)), impact


def _first(happens: Numbers) -> Numbers:
    """Return the number of the first step in which something happens, that after the last where nothing does."""
    steps = happens.shape[-1]
    return jnp.where(happens, jnp.arange(steps), steps).min(axis=-1, keepdims=True)


def _occupied(now: Situation, driven: DrivenPlans) -> EachStep:
    """Return length and width of what others may occupy [m]: more of their way where it crosses the robot's.

    Nobody knows when exactly a car comes that may brake or speed up; where it is now is known.
    """
    early = jnp.minimum(EARLY * driven.speeds + 0.5, UNSURE * now.planning.times**2 / 2)
    early = jnp.where((driven.cosine < SAME_WAY) & (driven.speeds > STANDING), early, 0.0)
    lengths, widths = now.scene.sizes.T[..., None]
    return jnp.stack([lengths + 2 * early, jnp.broadcast_to(widths, early.shape)], axis=-1)


def _avoidable(now: Situation, driven: DrivenPlans) -> EachFlag:
    """Return whether the robot can still stop before where a car crosses its route, soon after a plan has begun."""
    s, _, _, speed = driven.robot[..., DECIDED]
    left = now.crossings.line - s - now.scene.size[0]
    return now.crossings.exist & (left > speed**2 / (2 * STOPPING * now.planning.grip))


def blocks(now: Situation, driven: DrivenPlans) -> EachFlag:
    """Return whether the robot, after a plan, is still where a car crosses its route when that car comes.

    The robot goes on as fast as it is then, and faster; the car at its speed. Who comes towards it in its lane counts
    in `ms_highway.road.prospects.prospects`.
    """
    scene, ways = now.scene, now.crossings
    s, d, _, speed = driven.robot[..., -1]
    rear, front = s[..., None] - CLEARANCE, s[..., None] + scene.size[0] + CLEARANCE
    across = jnp.abs(ways.d - d[..., None]) < CORRIDOR
    here = across & (ways.s > rear) & (ways.s < front)
    leaving = (highest(ways.s, across) + CLEARANCE - s) / (speed + 1.0)
    along = driven.along[..., -1]
    coming = (lowest(ways.places, here) - scene.sizes[:, 0] - along) / jnp.maximum(driven.speeds[..., -1], 1.0)
    comes = (along < highest(ways.places, here)) & (coming < leaving + 0.5) & (coming < AWAITED)
    return scene.present & scene.moving & comes
