"""Score proposals: compute what they earn, and which constraints they break."""

from typing import NamedTuple

from jax import numpy as jnp

from ms_highway.game.car_following import FREE_GAP
from ms_highway.geometry.bodies import separation
from ms_highway.geometry.curve import Pose, interpolate, rotated
from ms_highway.perception.scene import (
    EachCar,
    EachFlag,
    EachStep,
    PlanFlags,
    PlanLanes,
    Plans,
    World,
)
from ms_highway.road.constants import RoadWeights
from ms_highway.road.proposals import Profiles
from ms_highway.road.simulation import DrivenPlans, earlier
from ms_highway.road.swing import aside_of
from ms_highway.road.terminal_value import terminal_value
from ms_highway.road.traffic import (
    CROSSING,
    SAME_WAY,
    STANDING_SPEED,
    Situation,
    highest,
    lane_of,
    lowest,
)
from ms_highway.runtime.arrays import Numbers


class Scores(NamedTuple):
    """Scores of plans.

    Attributes:
        own: reward without others.
        others: cost of each of the others.
        responsive: the part of this cost that may change if a car responds to the
            robot. It excludes cars ahead in the robot's lane, and costs after the plan.
        intrusion: depth of the plan in the margin around others [m]; at most that
            margin if it hits nobody.
        impact: highest relative speed at an unavoidable collision [m/s]; 0 without one.
        leaves: whether the plan leaves the road.
        missing: distance that the robot lacks to stop behind the car ahead, after the
            plan [m].
    """

    own: Plans
    others: EachCar
    responsive: EachCar
    intrusion: Plans
    impact: Plans
    leaves: PlanFlags
    missing: Plans

    @property
    def total(self) -> Plans:
        """Score of each plan, without its broken constraints."""
        return self.own - self.others.sum(axis=-1)

    @property
    def preference(self) -> Plans:
        """Order of the plans: sound ones first, then those that hit nobody, then those
        with the softest impact.
        """
        faults = jnp.where(
            self.impact > 0, 2 + self.impact, self.broken + self.intrusion
        )
        return self.total - RoadWeights.unsound * (
            faults + RoadWeights.off_road_impact * self.leaves
        )

    @property
    def collides(self) -> PlanFlags:
        """Whether a plan comes too close to somebody."""
        return self.intrusion > 0

    @property
    def broken(self) -> PlanFlags:
        """Whether a plan breaks a constraint."""
        return self.collides | self.leaves | (self.missing > 0)


def score(now: Situation, driven: DrivenPlans, plans: Profiles) -> Scores:
    """Score simulated plans."""
    lanes = plans.lane
    scene = now.scene
    planning = now.planning
    weights = now.weights
    desired = planning.desired_speed
    s, d, _, speed = jnp.moveaxis(driven.states, -1, 0)
    goal = lane_of(scene.lanes, lanes, s)
    off_speed = jnp.abs(speed - jnp.minimum(interpolate(now.caps, s), desired))
    aside = d - interpolate(now.inside, s) - goal
    per_second = (
        weights.speed * (1 - off_speed / desired)
        - weights.centre * aside**2
        - _discomfort(now, driven)
    )
    closed = (lane_of(scene.open.astype(float), lanes, s[:, -1]) < 0.5) & (lanes != 1)
    closed = closed | (
        (plans.side != 0) & ~now.obstruction.exists
    )  # there is no obstacle to pass
    leaves = _leaves(now, driven)
    off_road = weights.off_road * (leaves.astype(float) + closed)
    others, intrusion, impact = _collisions(now, driven, lanes)
    own, after, missing = terminal_value(now, driven, plans)
    return Scores(
        own=planning.time_step * per_second.sum(axis=1) - off_road + own,
        others=others + after,
        responsive=jnp.where(now.leading, 0.0, others),
        intrusion=intrusion,
        impact=impact,
        leaves=leaves | closed,
        missing=missing.max(axis=1),
    )


def _discomfort(now: Situation, driven: DrivenPlans) -> EachStep:
    """Return the cost of acceleration and jerk after each step."""
    scene, weights, (curvature, acceleration) = (
        now.scene,
        now.weights,
        jnp.moveaxis(driven.controls, -1, 0),
    )
    squared = earlier(scene.robot[3], driven.states[..., 3]) ** 2
    lateral = squared * curvature
    bend = interpolate(scene.route.curvature, driven.states[..., 0])
    before = (
        earlier(scene.robot[3] ** 2 * scene.applied[0], lateral),
        earlier(scene.applied[1], acceleration),
    )
    jerk = (
        (lateral - before[0]) ** 2 + (acceleration - before[1]) ** 2
    ) / now.planning.time_step**2
    return (
        weights.acceleration * (acceleration**2 + (lateral - squared * bend) ** 2)
        + weights.jerk * jerk
    )


def _leaves(now: Situation, driven: DrivenPlans) -> PlanFlags:
    """Return whether plans leave the road farther than in their first step, which they
    cannot change.
    """
    scene = now.scene
    length, width = scene.size
    left, right = interpolate(scene.edges, driven.states[..., 0] + length / 2)
    places = [
        (ahead, side) for ahead in (0.0, length) for side in (-width / 2, width / 2)
    ]
    corners = jnp.stack(
        [aside_of(scene, driven.states, ahead, side) for ahead, side in places]
    )
    beyond = jnp.maximum(left - corners.min(axis=0), corners.max(axis=0) - right)
    beyond = jnp.maximum(beyond, 0.0)
    return (beyond > beyond[:, :1] + now.weights.off_road_tolerance).any(axis=1)


def _collisions(
    now: Situation, driven: DrivenPlans, lanes: PlanLanes
) -> tuple[EachCar, Plans, Plans]:
    """Return the cost of the nearness of each car, the depth of plans in margins, and
    the speed of impacts.

    If the robot can still stop before a crossing car's path after the first step, later
    collisions with that car cost less and break no constraint, because the robot will
    plan again. The speed of an impact is the highest relative speed when bodies first
    touch.
    """
    scene = now.scene
    planning = now.planning
    weights = now.weights
    speeds = driven.speeds
    dt, steps, (s, d, _, speed) = (
        planning.time_step,
        jnp.arange(planning.steps),
        driven.robot,
    )
    own = _pose(driven.path[:, None])
    others = _pose(driven.world)
    # A follower in the robot's lane is ignored as long as both keep this lane, even if
    # it runs into the robot.
    behind = driven.s[..., :1] < s[..., :1] - 1.0
    followed = steps < _first(jnp.abs(driven.d - d) >= scene.size[1])
    stays = jnp.equal(lanes, 1)[:, None, None] | (
        steps < _first(jnp.abs(d - scene.robot[1]) >= weights.lane_change_offset)
    )
    counts = scene.present[:, None] & ~(
        behind & followed & (driven.cosine > CROSSING) & stays
    )
    clear = jnp.where(
        counts, separation(own, scene.size, others, _occupied(now, driven)), FREE_GAP
    )
    touch = counts & (separation(own, scene.size, others, scene.sizes[:, None]) < 0)
    onward, sideways = rotated(
        speeds * jnp.cos(others[2]), speeds * jnp.sin(others[2]), own[2]
    )
    relative = jnp.sqrt(jnp.maximum((speed - onward) ** 2 + sideways**2, 1e-4))
    avoidable = _avoidable(now, driven)
    binds = ~(avoidable[..., None] & (dt * steps > weights.certain_time))
    fading = weights.discount**steps * jnp.where(binds, 1.0, weights.avoidable)
    near = jnp.clip(1 - clear / weights.comfortable, 0.0, 1.0) ** 2
    braking = (earlier(scene.states[:, 3:], speeds) - speeds) / dt
    endangered = (driven.s < s) & (speeds > speed)  # the gap to slower followers grows
    imposed = jnp.where(
        endangered, jnp.maximum(braking - weights.tolerated_braking, 0.0), 0.0
    )
    depth = (
        jnp.where(scene.moving, weights.margin, weights.wreck_margin)[:, None] - clear
    )
    cost = (
        dt * weights.near * jnp.sum(near * fading, axis=-1)
        + dt * weights.imposed * jnp.sum(imposed**2, axis=-1)
        + weights.collision * jnp.max(jnp.where(depth > 0, fading, 0.0), axis=-1)
        + weights.blocking
        * blocks(now, driven)
        * jnp.where(avoidable, weights.avoidable, 1.0)
    )
    impact = jnp.where((steps == _first(touch)) & binds, relative, 0.0).max(axis=(1, 2))
    return cost, jnp.where(binds, jnp.maximum(depth, 0.0), 0.0).max(axis=(1, 2)), impact


def _pose(world: World) -> Pose:
    x, y, heading, _ = jnp.moveaxis(world, -2, 0)
    return x, y, heading


def _first(happens: Numbers) -> Numbers:
    """Return the number of the first step in which something happens, or the number of
    steps where nothing does.
    """
    steps = happens.shape[-1]
    return jnp.where(happens, jnp.arange(steps), steps).min(axis=-1, keepdims=True)


def _occupied(now: Situation, driven: DrivenPlans) -> EachStep:
    """Return length and width of the space that others may occupy [m]: longer for
    crossing cars.

    Their time of arrival is uncertain, since they may brake or speed up; their present
    position is known.
    """
    weights = now.weights
    times = now.planning.times
    early = jnp.minimum(
        weights.arrival_error * driven.speeds + 0.5,
        weights.acceleration_error * times**2 / 2,
    )
    early = jnp.where(
        (driven.cosine < SAME_WAY) & (driven.speeds > STANDING_SPEED), early, 0.0
    )
    lengths, widths = now.scene.sizes.T[..., None]
    return jnp.stack(
        [lengths + 2 * early, jnp.broadcast_to(widths, early.shape)], axis=-1
    )


def _avoidable(now: Situation, driven: DrivenPlans) -> EachFlag:
    """Return whether the robot can still stop before the path of each crossing car
    after the first steps of a plan.
    """
    s, _, _, speed = driven.robot[..., now.weights.replanned_step]
    left = now.crossings.line - s - now.scene.size[0]
    return now.crossings.exist & (
        left > speed**2 / (2 * now.planning.stopping * now.planning.grip)
    )


def blocks(now: Situation, driven: DrivenPlans) -> EachFlag:
    """Return whether the robot, after a plan, still stands in the way of each crossing
    car when that car arrives.

    The car keeps its speed, and the robot goes on a little faster than at the end of
    the plan. Oncoming cars in the robot's lane count in
    `ms_highway.road.terminal_value.speed_lost`.
    """
    scene = now.scene
    weights = now.weights
    ways = now.crossings
    end = driven.end
    s, d, _, speed = driven.robot[..., -1]
    rear = s[..., None] - weights.clearance
    front = s[..., None] + scene.size[0] + weights.clearance
    across = jnp.abs(ways.d - d[..., None]) < weights.corridor
    here = across & (ways.s > rear) & (ways.s < front)
    leaving = (highest(ways.s, across) + weights.clearance - s) / (speed + 1.0)
    coming = (lowest(ways.places, here) - scene.sizes[:, 0] - end.along) / jnp.maximum(
        end.speeds, 1.0
    )
    comes = end.along < highest(ways.places, here)
    return (
        scene.moving
        & comes
        & (coming < leaving + weights.crossing_time_gap)
        & (coming < weights.crossing_horizon)
    )
