"""Score proposals: compute what they earn, and which constraints they break.

Costs of others are sums over paths: a car with several paths counts several times.
"""

from dataclasses import dataclass
from typing import NamedTuple

from jax import numpy as jnp
from jaxtyping import Bool, Int

from ms_highway.game.car_following import FREE_GAP
from ms_highway.geometry.bodies import separation
from ms_highway.geometry.curve import Pose, interpolate, rotated
from ms_highway.perception.scene import (
    SHAPE,
    FlagPerPath,
    PerPath,
    PerPathAndStep,
    PerPlan,
    PlanFlags,
    PlanLanes,
    Steps,
    World,
)
from ms_highway.road.proposals import Profiles
from ms_highway.road.simulation import SimulatedPlans, earlier
from ms_highway.road.swing import lateral_position
from ms_highway.road.terminal_value import terminal_value
from ms_highway.road.traffic import (
    COSINES,
    CROSSING,
    STANDING_SPEED,
    Situation,
    highest,
    lane_of,
    lowest,
)
from ms_highway.runtime.arrays import Array, Numbers


@dataclass(frozen=True)
class ConstraintSettings:
    """Set which plans are infeasible, and how much worse they rank."""

    infeasible: float = 1e3
    """Cost of a broken constraint; it exceeds whatever else plans earn or cost."""
    off_road_impact: float = 10.0
    """Speed of an impact that is as bad as leaving the road [m/s]."""
    off_road_tolerance: float = 0.1
    """Increase of the distance off the road that counts as leaving it [m]."""
    margin: float = 0.35
    """Distance between bodies that counts as a collision: predictions err by this much
    in a step [m].
    """
    wreck_margin: float = 0.6
    """The same to obstacles, which plans pass in steps of 0.2 s [m]."""
    certain_time: float = 1.6
    """Time up to which predicted collisions count even if the plan could still stop
    [s].
    """
    replanned_step: int = 1
    """First step from which a plan must be able to stop before a crossing; the next
    plan starts there.
    """


CONSTRAINTS = ConstraintSettings()


@dataclass(frozen=True)
class PredictionErrors:
    """Set how far others may deviate from their prediction."""

    discount: float = 0.95
    """Factor per step by which expected costs shrink, as predictions get worse."""
    arrival_time: float = 0.08
    """Time by which crossing cars may arrive earlier or later than predicted [s]."""
    arrival_distance: float = 0.5
    """The same as a distance, also for slow cars [m]."""
    acceleration: float = 6.0
    """Acceleration by which others may deviate [m/s^2]."""


ERRORS = PredictionErrors()


@dataclass(frozen=True)
class FollowerSettings:
    """Set what the robot owes to the cars behind it."""

    tolerated_braking: float = 1.5
    """Braking of others that costs nothing, as when a driver lifts off the accelerator
    [m/s^2].
    """
    lane_change_offset: float = 0.5
    """Lateral offset from which a lane change has begun [m]."""
    behind: float = 1.0
    """Distance behind the robot's rear axle from which on a car is behind it [m]."""


FOLLOWERS = FollowerSettings()


@dataclass(frozen=True)
class BlockedCrossing:
    """Set when a robot that stands on a crossing blocks a crossing car."""

    clearance: float = 1.0
    """Distance before and behind the robot to crossing cars [m]."""
    time_horizon: float = 6.0
    """Crossing cars that arrive later do not count [s]."""
    time_gap: float = 0.5
    """Least time between the robot's leaving a crossing and the arrival of the next car
    [s].
    """
    speeding_up: float = 1.0
    """Excess of the robot's later speed over that at the end of the plan [m/s]."""
    lowest_speed: float = 1.0
    """Lowest speed at which crossing cars are expected to arrive [m/s]."""


BLOCKED_CROSSING = BlockedCrossing()


class Scores(NamedTuple):
    """Scores of plans.

    Attributes:
        own_value: reward without others.
        costs_by_path: cost that each path of another car causes.
        responsive: the part of this cost that may change if a car responds to the
            robot. It excludes cars ahead in the robot's lane, and terminal costs. The
            choice of models uses it, see `ms_highway.road.plan.propose_road`.
        intrusion: depth of the plan in the margin around others [m]; at most that
            margin if it hits nobody.
        impact: highest relative speed at an unavoidable collision [m/s]; 0 without one.
        leaves: whether the plan leaves the road.
        gap_shortfall: largest shortfall of a gap to a car ahead, after the plan or
            within it [m].
    """

    own_value: PerPlan
    costs_by_path: PerPath
    responsive: PerPath
    intrusion: PerPlan
    impact: PerPlan
    leaves: PlanFlags
    gap_shortfall: PerPlan

    @property
    def total(self) -> PerPlan:
        """Score of each plan, without its broken constraints."""
        return self.own_value - self.costs_by_path.sum(axis=-1)

    @property
    def preference(self) -> PerPlan:
        """Order of the plans, the best one highest.

        Feasible ones come first, then those that hit nobody, then those with the
        softest impact.
        """
        faults = jnp.where(
            self.impact > 0, 2 + self.impact, self.broken + self.intrusion
        )
        off_road = CONSTRAINTS.off_road_impact * self.leaves
        return self.total - CONSTRAINTS.infeasible * (faults + off_road)

    @property
    def collides(self) -> PlanFlags:
        """Whether a plan comes too close to somebody."""
        return self.intrusion > 0

    @property
    def broken(self) -> PlanFlags:
        """Whether a plan breaks a constraint."""
        return self.collides | self.leaves | (self.gap_shortfall > 0)


def score(situation: Situation, simulated: SimulatedPlans, plans: Profiles) -> Scores:
    """Score simulated plans."""
    lanes = plans.lane
    scene = situation.scene
    planning = situation.planning
    weights = situation.weights
    desired = planning.desired_speed
    s, d, _, speed = jnp.moveaxis(simulated.states, -1, 0)  # each [plans, steps]

    # What a plan earns in each second: speed, the middle of its lane, and comfort.
    allowed = jnp.minimum(interpolate(situation.speed_caps, s), desired)
    speed_error = jnp.abs(speed - allowed)
    lane_centre = lane_of(scene.lanes, lanes, s)
    off_centre = d - interpolate(situation.inward_shift, s) - lane_centre
    per_second = (
        weights.speed * (1 - speed_error / desired)
        - weights.centre * off_centre**2
        - _discomfort(situation, simulated)
    )

    # Plans are infeasible that go to another lane which ends, or pass an obstacle that
    # does not exist.
    ends = lane_of(scene.open.astype(float), lanes, s[:, -1]) < 0.5
    is_closed = ends & (lanes != SHAPE.own_lane)
    passes_nothing = (plans.side != 0) & ~situation.obstruction.exists
    is_closed = is_closed | passes_nothing
    leaves = _leaves(situation, simulated)
    off_road = weights.off_road * (leaves.astype(float) + is_closed)

    collisions = _collisions(situation, simulated, lanes)
    terminal = terminal_value(situation, simulated, plans)
    within_plan = planning.time_step * per_second.sum(axis=1) - off_road
    return Scores(
        own_value=within_plan + terminal.own_value,
        costs_by_path=collisions.cost + terminal.costs_by_path,
        responsive=jnp.where(situation.leading, 0.0, collisions.cost),
        intrusion=collisions.intrusion,
        impact=collisions.impact,
        leaves=leaves | is_closed,
        gap_shortfall=terminal.gap_shortfall.max(axis=1),
    )


def _discomfort(situation: Situation, simulated: SimulatedPlans) -> Steps:
    """Return the cost of acceleration and jerk after each step [plans, steps].

    Lateral acceleration on the road's own bend costs nothing.
    """
    scene = situation.scene
    weights = situation.weights
    curvature, acceleration = jnp.moveaxis(simulated.controls, -1, 0)

    # Longitudinal acceleration, and the lateral one beyond that of the road.
    present_speed = scene.robot[3]
    squared_speed = earlier(present_speed, simulated.states[..., 3]) ** 2
    lateral = squared_speed * curvature
    bend = interpolate(scene.route.curvature, simulated.states[..., 0])
    excess_lateral = lateral - squared_speed * bend
    squared = acceleration**2 + excess_lateral**2

    # Jerk is the change of both since the step before, also of the applied control.
    applied_curvature, applied_acceleration = scene.applied
    applied_lateral = present_speed**2 * applied_curvature
    lateral_change = lateral - earlier(applied_lateral, lateral)
    acceleration_change = acceleration - earlier(applied_acceleration, acceleration)
    squared_change = lateral_change**2 + acceleration_change**2
    squared_jerk = squared_change / situation.planning.time_step**2
    return weights.acceleration * squared + weights.jerk * squared_jerk


def _leaves(situation: Situation, simulated: SimulatedPlans) -> PlanFlags:
    """Return whether plans leave the road farther than after their first step.

    A plan can hardly change the first step.
    """
    scene = situation.scene
    states = simulated.states
    length, width = scene.size
    middle = states[..., 0] + length / 2
    left_edge, right_edge = interpolate(scene.edges, middle)

    # Lateral positions of the four corners, [corners, plans, steps].
    corners = jnp.stack(
        [
            lateral_position(scene, states, 0.0, -width / 2),
            lateral_position(scene, states, 0.0, width / 2),
            lateral_position(scene, states, length, -width / 2),
            lateral_position(scene, states, length, width / 2),
        ]
    )
    beyond_left = left_edge - corners.min(axis=0)
    beyond_right = corners.max(axis=0) - right_edge
    beyond = jnp.maximum(jnp.maximum(beyond_left, beyond_right), 0.0)
    after_first_step = beyond[:, :1]
    leaves = beyond > after_first_step + CONSTRAINTS.off_road_tolerance
    return leaves.any(axis=1)


class Collisions(NamedTuple):
    """How plans get along with others.

    Attributes:
        cost: of the nearness of each car.
        intrusion: depth of the plan in the margin around others [m].
        impact: highest relative speed at an unavoidable collision [m/s].
    """

    cost: PerPath
    intrusion: PerPlan
    impact: PerPlan


def _collisions(
    situation: Situation,
    simulated: SimulatedPlans,
    lanes: PlanLanes,
) -> Collisions:
    """Return what the nearness of others costs, and which plans collide.

    If the robot can still stop before a crossing car's path after the first step, later
    collisions with that car cost less and break no constraint, because the robot will
    plan again. The speed of an impact is the highest relative speed when bodies first
    touch.

    Arrays without another comment are [plans, traffic, steps].
    """
    scene = situation.scene
    weights = situation.weights
    dt = situation.planning.time_step
    steps = jnp.arange(situation.planning.steps)
    own_pose = _pose(simulated.centre[:, None])
    other_pose = _pose(simulated.world)

    # Distances to the space that others may occupy, and to their bodies.
    counts = _counts(situation, simulated, lanes)
    occupied = _occupied(situation, simulated)
    distance = separation(own_pose, scene.size, other_pose, occupied)
    distance = jnp.where(counts, distance, FREE_GAP)
    body_distance = separation(own_pose, scene.size, other_pose, scene.sizes[:, None])
    touches = counts & (body_distance < 0)

    # Collisions that a later plan can avoid cost less; expected costs fade with time.
    avoidable = _avoidable(situation, simulated)  # [plans, traffic]
    is_uncertain = dt * steps > CONSTRAINTS.certain_time  # [steps]
    binds = ~(avoidable[..., None] & is_uncertain)
    fading = ERRORS.discount**steps * jnp.where(binds, 1.0, weights.avoidable)

    # Nearness, and braking of those behind, summed over steps.
    near = jnp.clip(1 - distance / weights.comfortable, 0.0, 1.0) ** 2
    near_cost = dt * weights.near * jnp.sum(near * fading, axis=-1)
    imposed = _imposed_braking(situation, simulated)
    imposed_cost = dt * weights.imposed * jnp.sum(imposed**2, axis=-1)

    # Collisions, the first of which fades least, and blocked crossings.
    margin = jnp.where(scene.moving, CONSTRAINTS.margin, CONSTRAINTS.wreck_margin)
    depth = margin[:, None] - distance
    collision = jnp.max(jnp.where(depth > 0, fading, 0.0), axis=-1)
    collision_cost = weights.collision * collision
    blocked = blocks(situation, simulated)
    blocking_factor = jnp.where(avoidable, weights.avoidable, 1.0)
    blocking_cost = weights.blocking * blocked * blocking_factor
    cost = near_cost + imposed_cost + collision_cost + blocking_cost  # [plans, traffic]

    # What breaks constraints.
    intrusion = jnp.where(binds, jnp.maximum(depth, 0.0), 0.0)
    is_impact = (steps == _first(touches)) & binds
    relative = _relative_speed(simulated, own_pose[2], other_pose[2])
    impact = jnp.where(is_impact, relative, 0.0)
    return Collisions(cost, intrusion.max(axis=(1, 2)), impact.max(axis=(1, 2)))


def _counts(
    situation: Situation,
    simulated: SimulatedPlans,
    lanes: PlanLanes,
) -> Bool[Array, "*plans traffic steps"]:
    """Return in which steps the robot is to blame for touching each of the others.

    A follower in the robot's lane is ignored as long as both keep this lane, even if it
    runs into the robot.
    """
    scene = situation.scene
    traffic = simulated.traffic
    steps = jnp.arange(situation.planning.steps)
    s, d, *_ = simulated.robot

    is_behind = traffic.s[..., :1] < s[..., :1] - FOLLOWERS.behind
    is_beside = jnp.abs(traffic.d - d) >= scene.size[1]
    in_line = steps < _first(is_beside)
    has_moved = jnp.abs(d - scene.robot[1]) >= FOLLOWERS.lane_change_offset
    goes_to_own_lane = jnp.equal(lanes, SHAPE.own_lane)[:, None, None]
    keeps_lane = goes_to_own_lane | (steps < _first(has_moved))
    follows = is_behind & in_line & (traffic.cosine > COSINES.not_crossing) & keeps_lane
    return scene.present[:, None] & ~follows


def _imposed_braking(situation: Situation, simulated: SimulatedPlans) -> PerPathAndStep:
    """Return the braking that the robot imposes on each car behind it [m/s^2].

    Braking that drivers tolerate does not count.
    """
    s, _, _, speed = simulated.robot
    other_speed = simulated.traffic.speed
    last_speed = earlier(situation.scene.states[:, 3:], other_speed)
    braking = (last_speed - other_speed) / situation.planning.time_step

    # The gap to slower followers grows.
    closes_in = (simulated.traffic.s < s) & (other_speed > speed)
    excess = jnp.maximum(braking - FOLLOWERS.tolerated_braking, 0.0)
    return jnp.where(closes_in, excess, 0.0)


def _relative_speed(
    simulated: SimulatedPlans,
    own_heading: Numbers,
    other_heading: Numbers,
) -> PerPathAndStep:
    """Return the speed of others relative to the robot [m/s].

    Args:
        simulated: the plans.
        own_heading: of the robot [rad].
        other_heading: of the others [rad].
    """
    _, _, _, speed = simulated.robot
    other_speed = simulated.traffic.speed
    x_speed = other_speed * jnp.cos(other_heading)
    y_speed = other_speed * jnp.sin(other_heading)
    forward, sideways = rotated(x_speed, y_speed, own_heading)
    return jnp.sqrt(jnp.maximum((speed - forward) ** 2 + sideways**2, 1e-4))


def _pose(world: World) -> Pose:
    x, y, heading, _ = jnp.moveaxis(world, -2, 0)
    return x, y, heading


def _first(happens: Bool[Array, "*rows steps"]) -> Int[Array, "*rows 1"]:
    """Return the number of the first step in which something happens.

    It is the number of steps where nothing does.
    """
    steps = happens.shape[-1]
    return jnp.where(happens, jnp.arange(steps), steps).min(axis=-1, keepdims=True)


def _occupied(situation: Situation, simulated: SimulatedPlans) -> PerPathAndStep:
    """Return length and width of the space that others may occupy [m].

    The space of crossing cars is longer. Their time of arrival is uncertain, since they
    may brake or speed up; their present position is known.
    """
    traffic = simulated.traffic
    times = situation.planning.times
    by_arrival = ERRORS.arrival_time * traffic.speed + ERRORS.arrival_distance
    by_acceleration = ERRORS.acceleration * times**2 / 2
    error = jnp.minimum(by_arrival, by_acceleration)
    is_crossing = (traffic.cosine < COSINES.same_way) & (traffic.speed > STANDING_SPEED)
    error = jnp.where(is_crossing, error, 0.0)

    lengths, widths = situation.scene.sizes.T[..., None]
    widths = jnp.broadcast_to(widths, error.shape)
    return jnp.stack([lengths + 2 * error, widths], axis=-1)


def _avoidable(situation: Situation, simulated: SimulatedPlans) -> FlagPerPath:
    """Return whether the robot can still stop before each crossing path.

    It has to be able to do so after the first steps of a plan.
    """
    planning = situation.planning
    crossings = situation.crossings
    s, _, _, speed = simulated.robot[..., CONSTRAINTS.replanned_step]
    room = crossings.line - s - situation.scene.size[0]
    needed = speed**2 / (2 * planning.stopping * planning.grip)
    return crossings.exist & (room > needed)


def blocks(situation: Situation, simulated: SimulatedPlans) -> FlagPerPath:
    """Return whether a plan ends in the way of each crossing car.

    The robot then still stands there when the car arrives. The car keeps its speed, and
    the robot goes on a little faster than at the end of the plan. Oncoming cars in the
    robot's lane count in `ms_highway.road.cost_to_go`.
    """
    scene = situation.scene
    crossings = situation.crossings
    end = simulated.traffic.last
    s, d, _, speed = simulated.robot[..., -1]  # each [plans, 1]

    # Places of the crossing on which the robot stands, [plans, traffic, places].
    clearance = BLOCKED_CROSSING.clearance
    rear = s[..., None] - clearance
    front = s[..., None] + scene.size[0] + clearance
    in_corridor = jnp.abs(crossings.d - d[..., None]) < CROSSING.corridor
    is_under_robot = in_corridor & (crossings.s > rear) & (crossings.s < front)

    # When the robot has left the crossing, and when the car arrives there.
    distance_to_clear = highest(crossings.s, in_corridor) + clearance - s
    leaving_time = distance_to_clear / (speed + BLOCKED_CROSSING.speeding_up)
    first_place = lowest(crossings.places, is_under_robot)
    way_there = first_place - scene.sizes[:, 0] - end.along
    arrival_time = way_there / jnp.maximum(end.speed, BLOCKED_CROSSING.lowest_speed)
    has_not_passed = end.along < highest(crossings.places, is_under_robot)
    return (
        scene.moving
        & has_not_passed
        & (arrival_time < leaving_time + BLOCKED_CROSSING.time_gap)
        & (arrival_time < BLOCKED_CROSSING.time_horizon)
    )
