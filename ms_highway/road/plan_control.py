"""Compute the control of a plan in a step.

A plan steers to its target, follows the cars ahead, yields to crossing cars, and
slows down for bends.
"""

from dataclasses import dataclass

import jax
from jax import numpy as jnp

from ms_highway.game.car_following import FREE_GAP, ROBOT_IDM
from ms_highway.geometry.curve import SPACING, interpolate
from ms_highway.perception.scene import SHAPE, Traffic
from ms_highway.road.following import TrafficMotion
from ms_highway.road.proposals import Profiles
from ms_highway.road.traffic import CROSSING, OBSTACLES, PASSING_GAP, Situation, lowest
from ms_highway.runtime.arrays import Car, Control, Scalar


@dataclass(frozen=True)
class RoadSteering:
    """Set how plans steer to the middle of a lane."""

    frequency: float = 1.6
    """Of the critically damped motion to the middle [rad/s]."""
    lateral_acceleration: float = 3.0
    """Largest lateral acceleration of this motion [m/s^2]."""
    lowest_speed: float = 3.0
    """Below this speed, steering is not sharper than at this speed [m/s]."""


STEERING = RoadSteering()


@dataclass(frozen=True)
class SpeedControl:
    """Set how plans that follow the traffic choose their speed."""

    preview: float = 0.4
    """Time that the robot looks ahead for speed limits: two steps [s]."""
    gain: float = 0.8
    """Acceleration per difference to the desired speed [1/s]."""
    acceleration: float = 3.0
    """Largest acceleration to the desired speed [m/s^2]."""
    following_gain: float = 2.0
    """Factor of the acceleration of the Intelligent Driver Model."""
    unlimited_speed: float = 1e3
    """Desired speed in the Intelligent Driver Model, so high that only the car ahead
    matters there [m/s].
    """


SPEED_CONTROL = SpeedControl()


@dataclass(frozen=True)
class ClosingUp:
    """Set how plans close up to the car ahead, as late as is safe."""

    braking: float = 2.0
    """Deceleration at the end [m/s^2]."""
    gap: float = 1.5
    """Gap that is left [m]."""
    reaction_time: float = 0.25
    """Time before the robot brakes [s]."""


CLOSING_UP = ClosingUp()


@dataclass(frozen=True)
class Yielding:
    """Set how plans yield to crossing cars."""

    lowest_speed: float = 3.0
    """Lowest speed at which crossing cars are expected to arrive [m/s]."""
    passed_margin: float = 1.0
    """Distance behind a crossing car from which on it has passed [m]."""


YIELD = Yielding()


@dataclass(frozen=True)
class LaneChangeGaps:
    """Set when plans change lanes beside others while cars come towards the robot."""

    gap: float = 0.5
    """To others beside the robot, below which a plan does not change lanes [m]."""
    passing_time: float = 3.0
    """Time before it passes them within which it does not change lanes either [s]."""


LANE_CHANGE_GAPS = LaneChangeGaps()


def target_of(situation: Situation, plan: Profiles, s: Scalar) -> jax.Array:
    """Return the lateral position that a plan steers to at s [m].

    Args:
        situation: what all plans share.
        plan: the plan.
        s: position of the rear axle [m].
    """
    obstruction = situation.obstruction
    passes = (plan.side != 0) & obstruction.exists & (s < obstruction.end)
    lane_centre = interpolate(situation.scene.lanes[plan.lane], s)
    passing_side = obstruction.sides[(plan.side > 0).astype(int)]
    return jnp.where(passes, passing_side, lane_centre)


def plan_control(
    situation: Situation,
    plan: Profiles,
    car: Car,
    traffic: TrafficMotion,
) -> Control:
    """Return the robot's control in a step of a plan."""
    s, _, _, speed = car
    target = target_of(situation, plan, s)
    distance = traffic.s - (s + situation.scene.size[0] / 2)  # between centres

    goal = _lateral_goal(situation, plan, car, traffic, target, distance)
    curvature = _curvature(situation, car, goal)

    # Reach the desired speed or the cap, behind the cars ahead.
    cap = _speed_cap(situation, plan, car, traffic)
    behind = _behind_others(situation, plan, car, traffic, target, distance)
    desired = jnp.minimum(cap, plan.speed_share * situation.planning.desired_speed)
    free = SPEED_CONTROL.gain * (desired - speed)
    free = jnp.clip(free, -SPEED_CONTROL.acceleration, SPEED_CONTROL.acceleration)
    following = jnp.minimum(free, behind)

    # Plans of constant acceleration keep to the cap, too.
    acceleration = jnp.where(plan.follows, following, plan.acceleration)
    to_cap = jnp.maximum(
        (cap - speed) / SPEED_CONTROL.preview, -situation.planning.grip
    )
    return jnp.stack([curvature, jnp.minimum(acceleration, to_cap)])


def _lateral_goal(
    situation: Situation,
    plan: Profiles,
    car: Car,
    traffic: TrafficMotion,
    target: Scalar,
    distance: Traffic,
) -> Scalar:
    """Return the lateral position to steer to [m].

    It is the target, or the present lane while the plan waits. If others come towards
    the robot in its lane, wait before changing lanes: plans that follow, until they
    have dropped behind the cars beside them; other plans, until they have overtaken
    them. Halfway into the lane, go on.
    """
    scene = situation.scene
    s, d, _, speed = car
    contact_length = situation.contact[:, 0]
    lateral_gap = situation.contact[:, 1] + PASSING_GAP

    # The gap that the plan needs to cars in its target lane.
    overtakes = ~plan.follows & (distance > 0)
    closing_speed = jnp.maximum(speed - traffic.forward_speed, 0.0)
    passing = jnp.where(overtakes, LANE_CHANGE_GAPS.passing_time * closing_speed, 0.0)
    needed = contact_length + LANE_CHANGE_GAPS.gap + passing

    in_target_lane = (
        (jnp.abs(traffic.d - target) < lateral_gap)
        & (jnp.abs(d - target) > lateral_gap)
        & scene.present
    )
    is_blocked = (in_target_lane & (jnp.abs(distance) < needed)).any()
    is_opposed = (situation.crossings.oncoming & (traffic.s > s)).any()
    present_lane = interpolate(scene.lanes[SHAPE.own_lane], s)
    return jnp.where(is_blocked & is_opposed, present_lane, target)


def _curvature(situation: Situation, car: Car, goal: Scalar) -> Scalar:
    """Return the curvature that steers the rear axle to a lateral position.

    The lateral acceleration is that of a critically damped spring, ``-w^2 d - 2 w v
    sin(heading)``. In a bend, the rear axle points inwards by half the turn of a frame,
    see
    `ms_highway.road.robot_motion.advance`; in a sharp one, it is inside the target.
    """
    scene = situation.scene
    planning = situation.planning
    s, d, heading, speed = car

    turn = interpolate(scene.route.curvature, s + 0.5 * speed * planning.time_step)

    # The heading relative to the line that the rear axle should follow.
    shift = interpolate(situation.inward_shift, s)
    next_shift = interpolate(situation.inward_shift, s + SPACING)
    shift_slope = (next_shift - shift) / SPACING
    relative_heading = heading - shift_slope - turn * speed * planning.lag

    # Return to this line like a spring, besides the curvature of the road.
    frequency = STEERING.frequency
    largest = STEERING.lateral_acceleration
    to_goal = -(frequency**2) * (d - shift - goal)
    damping = 2 * frequency * speed * jnp.sin(relative_heading)
    lateral = jnp.clip(to_goal - damping, -largest, largest)
    squared = jnp.maximum(speed, STEERING.lowest_speed) ** 2
    road_curvature = turn / jnp.maximum(1 - d * turn, 0.2)
    return road_curvature + lateral / squared


def _speed_cap(
    situation: Situation,
    plan: Profiles,
    car: Car,
    traffic: TrafficMotion,
) -> Scalar:
    """Return the highest speed from which the robot can still slow down [m/s].

    It slows down for bends ahead, and waits for crossing cars until they have passed.
    Past the waiting line, the robot goes on.
    """
    scene = situation.scene
    planning = situation.planning
    crossings = situation.crossings
    s, _, _, speed = car
    lengths = scene.sizes[:, 0]

    # Crossing cars that arrive soon, and have not passed.
    way = jnp.maximum(crossings.begin - lengths / 2, 0.0)
    arrival = way / jnp.maximum(scene.states[:, 3], YIELD.lowest_speed)
    passed = crossings.last + lengths / 2 + YIELD.passed_margin
    is_awaited = scene.moving & (arrival < plan.yield_time) & (traffic.along < passed)

    # Braking by b stops within x from the speed sqrt(2 b x).
    front = s + scene.size[0]
    to_line = crossings.line - front
    is_before_line = to_line > -CROSSING.waiting_gap
    room = lowest(to_line, is_awaited & is_before_line) - SPEED_CONTROL.preview * speed
    stopping = jnp.sqrt(2 * planning.stopping * planning.grip * jnp.maximum(room, 0.0))
    bends = interpolate(situation.speed_caps, s + SPEED_CONTROL.preview * speed)
    return jnp.minimum(bends, stopping)


def _behind_others(
    situation: Situation,
    plan: Profiles,
    car: Car,
    traffic: TrafficMotion,
    target: Scalar,
    distance: Traffic,
) -> Scalar:
    """Return the acceleration behind the cars ahead [m/s^2].

    They are those in this lane and in the target lane.
    """
    scene = situation.scene
    _, d, _, speed = car

    # Cars ahead between the robot and its target. A plan that passes an obstacle
    # ignores obstacles; other plans leave room before them to turn round them.
    lateral_gap = situation.contact[:, 1] + PASSING_GAP
    leftmost = jnp.minimum(d, target) - lateral_gap
    rightmost = jnp.maximum(d, target) + lateral_gap
    in_way = (traffic.d > leftmost) & (traffic.d < rightmost)
    in_way = in_way & (scene.moving | (plan.side == 0))
    turns_before = ~scene.moving & (plan.lane == SHAPE.own_lane)
    turning_room = OBSTACLES.turning_room * turns_before
    contact = situation.contact[:, 0] + turning_room
    counts = (distance > 0) & in_way & scene.present
    gap = jnp.where(counts, distance - contact, FREE_GAP)

    # Either follow by the Intelligent Driver Model ...
    following = ROBOT_IDM.acceleration(
        speed, SPEED_CONTROL.unlimited_speed, gap, traffic.forward_speed
    )
    following = SPEED_CONTROL.following_gain * following.min()

    # ... or drive at the highest speed from which gentle braking still suffices.
    room = gap - CLOSING_UP.gap - CLOSING_UP.reaction_time * speed
    gained = jnp.sqrt(2 * CLOSING_UP.braking * jnp.maximum(room, 0.0))
    safe_speed = traffic.forward_speed + gained
    closing_up = (safe_speed.min() - speed) / SPEED_CONTROL.preview
    return jnp.where(plan.closes_up, closing_up, following)
