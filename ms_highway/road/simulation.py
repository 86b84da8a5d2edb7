"""Simulate plans of the robot in traffic: its rear axle moves along its heading, as in
highway-env.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.car_following import FREE_GAP, ROBOT_IDM
from ms_highway.geometry.curve import SPACING, Curve, Pose, interpolate
from ms_highway.perception.scene import (
    EachStep,
    RoadScene,
    States,
    Steps,
    Traffic,
    World,
)
from ms_highway.road.following import (
    Behaviour,
    TrafficMotion,
    lateral_positions,
    move_traffic,
    positions_and_speeds,
    traffic_motion,
)
from ms_highway.road.proposals import Profiles
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.traffic import CROSSING, OBSTACLES, PASSING_GAP, Situation, lowest
from ms_highway.runtime.arrays import Car, Control, ManyControls, Numbers, Scalar


@dataclass(frozen=True)
class GripUse:
    """Set how braking and steering share the grip."""

    lowest_speed: float = 1.0
    """Below this speed, curvature is limited as at this speed [m/s]."""
    largest_slip_sine: float = 0.9
    """Largest sine of the slip angle."""
    braking_share: float = 0.6
    """Share of the grip that braking may take before steering."""


GRIP_USE = GripUse()


@dataclass(frozen=True)
class LaneSteering:
    """Set how plans steer to the middle of a lane."""

    frequency: float = 1.6
    """Of the critically damped motion to the middle [rad/s]."""
    lateral_acceleration: float = 3.0
    """Largest lateral acceleration of this motion [m/s^2]."""
    lowest_speed: float = 3.0
    """Below this speed, steering is not sharper than at this speed [m/s]."""


STEERING = LaneSteering()


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


SPEED = SpeedControl()


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


YIELDING = Yielding()


@dataclass(frozen=True)
class LaneChangeGaps:
    """Set when plans change lanes beside others while cars come towards the robot."""

    gap: float = 0.5
    """To others beside the robot, below which a plan does not change lanes [m]."""
    passing_time: float = 3.0
    """Time before it passes them within which it does not change lanes either [s]."""


LANE_CHANGE = LaneChangeGaps()


class SimulatedPlans(NamedTuple):
    """Simulated plans.

    Attributes:
        states: states of the robot after each step, in road coordinates.
        controls: executed controls of the robot.
        centre: trajectories of the robot's centre.
        world: trajectories of others.
        traffic: motion of others on the robot's route after each step.
    """

    states: States
    controls: ManyControls
    centre: World
    world: World
    traffic: TrafficMotion

    @property
    def robot(self) -> EachStep:
        """The robot's s, d, heading and speed, [4, plans, 1, steps]."""
        return jnp.moveaxis(self.states[:, None], -1, 0)


class StepRecord(NamedTuple):
    """What a step of the simulation records: the robot's state and executed control,
    and the fields of a `TrafficMotion`.
    """

    state: Car
    control: Control
    along: Traffic
    speed: Traffic
    s: Traffic
    d: Traffic
    cosine: Traffic


def simulate(
    situation: Situation, behaviour: Behaviour, plans: Profiles
) -> SimulatedPlans:
    """Simulate plans among others that respond to each of them."""
    scene = situation.scene
    planning = situation.planning
    across = lateral_positions(scene, planning.times)  # [traffic, steps]
    start = (scene.robot, *positions_and_speeds(scene))

    def simulate_one(plan: Profiles, accelerations: EachStep) -> StepRecord:
        """Simulate a plan, given the accelerations of others that do not follow."""

        def step(carry: tuple, inputs: tuple) -> tuple[tuple, StepRecord]:
            car, along, speed = carry
            given_control, step_across, rows = inputs
            traffic = traffic_motion(situation, along, step_across, speed)

            own_control = _control(situation, plan, car, traffic)
            wanted = jnp.where(plan.is_given, given_control, own_control)
            next_car, control = advance(scene, planning, car, wanted)
            along, speed = move_traffic(situation, behaviour, rows, traffic, car)

            s, d, cosine = situation.paths.at(along, step_across)
            record = StepRecord(next_car, control, along, speed, s, d, cosine)
            return (next_car, along, speed), record

        # What others do in each step, [steps, 3, traffic].
        rows = jnp.stack([accelerations, behaviour.residual, behaviour.limit])
        rows = rows.T.swapaxes(1, 2)
        return jax.lax.scan(step, start, (plan.controls, across.T, rows))[1]

    records = jax.vmap(simulate_one)(plans, behaviour.accelerations)

    # Others have their steps in the last axis, [plans, traffic, steps].
    along, speed, s, d, cosine = (
        jnp.swapaxes(field, 1, 2)
        for field in (
            records.along,
            records.speed,
            records.s,
            records.d,
            records.cosine,
        )
    )
    x, y, heading = jax.vmap(Curve.place, (0, -2, 0), -2)(scene.paths, along, across)
    other_heading = heading + scene.askew - _slip(scene, along)
    return SimulatedPlans(
        records.state,
        records.control,
        centre=jnp.stack(
            [*bodies(scene, records.state), records.state[..., 3]], axis=-2
        ),
        world=jnp.stack([x, y, other_heading, speed], axis=-2),
        traffic=TrafficMotion(along, s, d, speed, cosine),
    )


def target_of(situation: Situation, plan: Profiles, s: Scalar) -> Scalar:
    """Return the lateral position that a plan steers to where its rear axle is at s
    [m].
    """
    obstruction = situation.obstruction
    passes = (plan.side != 0) & obstruction.exists & (s < obstruction.end)
    lane_centre = interpolate(situation.scene.lanes[plan.lane], s)
    passing_side = obstruction.sides[(plan.side > 0).astype(int)]
    return jnp.where(passes, passing_side, lane_centre)


def _slip(scene: RoadScene, along: EachStep) -> EachStep:
    """Return the slip angles of others: in bends, centres do not move along the
    heading.
    """
    bends = jax.vmap(Curve.bend, (0, -2), -2)(scene.paths, along)
    bends = jnp.where(scene.moving[:, None], bends, 0.0)
    sine = bends * scene.sizes[:, :1] / 2
    largest = GRIP_USE.largest_slip_sine
    return jnp.arcsin(jnp.clip(sine, -largest, largest))


# The control of a plan in a step


def _control(
    situation: Situation, plan: Profiles, car: Car, traffic: TrafficMotion
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
    free = SPEED.gain * (desired - speed)
    free = jnp.clip(free, -SPEED.acceleration, SPEED.acceleration)
    following = jnp.minimum(free, behind)

    # Plans of constant acceleration keep to the cap, too.
    acceleration = jnp.where(plan.follows, following, plan.acceleration)
    to_cap = jnp.maximum((cap - speed) / SPEED.preview, -situation.planning.grip)
    return jnp.stack([curvature, jnp.minimum(acceleration, to_cap)])


def _lateral_goal(
    situation: Situation,
    plan: Profiles,
    car: Car,
    traffic: TrafficMotion,
    target: Scalar,
    distance: Traffic,
) -> Scalar:
    """Return the lateral position to steer to: the target, or the present lane while
    the plan waits [m].

    If others come towards the robot in its lane, wait before changing lanes: plans that
    follow, until they have dropped behind the cars beside them; other plans, until they
    have overtaken them. Halfway into the lane, go on.
    """
    scene = situation.scene
    s, d, _, speed = car
    contact_length = scene.reach[:, 0]
    lateral_gap = scene.reach[:, 1] + PASSING_GAP

    # The gap that the plan needs to cars in its target lane.
    overtakes = ~plan.follows & (distance > 0)
    closing_speed = jnp.maximum(speed - traffic.forward_speed, 0.0)
    passing = jnp.where(overtakes, LANE_CHANGE.passing_time * closing_speed, 0.0)
    needed = contact_length + LANE_CHANGE.gap + passing

    in_target_lane = (
        (jnp.abs(traffic.d - target) < lateral_gap)
        & (jnp.abs(d - target) > lateral_gap)
        & scene.present
    )
    is_blocked = (in_target_lane & (jnp.abs(distance) < needed)).any()
    is_opposed = (situation.crossings.oncoming & (traffic.s > s)).any()
    present_lane = interpolate(scene.lanes[1], s)
    return jnp.where(is_blocked & is_opposed, present_lane, target)


def _curvature(situation: Situation, car: Car, goal: Scalar) -> Scalar:
    """Return the curvature that steers the rear axle to a lateral position.

    The lateral acceleration is that of a critically damped spring, ``-w^2 d - 2 w v
    sin(heading)``. In a bend, the rear axle points inwards by half the turn of a frame,
    see `advance`; in a sharp one, it is inside the target.
    """
    scene = situation.scene
    planning = situation.planning
    s, d, heading, speed = car

    turn = interpolate(scene.route.curvature, s + 0.5 * speed * planning.time_step)
    shift = interpolate(situation.inward_shift, s)
    next_shift = interpolate(situation.inward_shift, s + SPACING)
    shift_slope = (next_shift - shift) / SPACING
    relative_heading = heading - shift_slope - turn * speed * planning.lag

    frequency = STEERING.frequency
    lateral = -(frequency**2) * (d - shift - goal) - 2 * frequency * speed * jnp.sin(
        relative_heading
    )
    lateral = jnp.clip(
        lateral, -STEERING.lateral_acceleration, STEERING.lateral_acceleration
    )
    squared = jnp.maximum(speed, STEERING.lowest_speed) ** 2
    road_curvature = turn / jnp.maximum(1 - d * turn, 0.2)
    return road_curvature + lateral / squared


def _speed_cap(
    situation: Situation, plan: Profiles, car: Car, traffic: TrafficMotion
) -> Scalar:
    """Return the highest speed from which the robot can slow down for bends ahead and
    wait for crossing cars until they have passed [m/s].

    Past the waiting line, the robot goes on.
    """
    scene = situation.scene
    planning = situation.planning
    crossings = situation.crossings
    s, _, _, speed = car
    lengths = scene.sizes[:, 0]

    # Crossing cars that arrive soon, and have not passed.
    way = jnp.maximum(crossings.begin - lengths / 2, 0.0)
    arrival = way / jnp.maximum(scene.states[:, 3], YIELDING.lowest_speed)
    passed = crossings.last + lengths / 2 + YIELDING.passed_margin
    is_awaited = scene.moving & (arrival < plan.yield_time) & (traffic.along < passed)

    # Braking by b stops within x from the speed sqrt(2 b x).
    front = s + scene.size[0]
    to_line = crossings.line - front
    is_before_line = to_line > -CROSSING.waiting_gap
    room = lowest(to_line, is_awaited & is_before_line) - SPEED.preview * speed
    stopping = jnp.sqrt(2 * planning.stopping * planning.grip * jnp.maximum(room, 0.0))
    bends = interpolate(situation.speed_caps, s + SPEED.preview * speed)
    return jnp.minimum(bends, stopping)


def _behind_others(
    situation: Situation,
    plan: Profiles,
    car: Car,
    traffic: TrafficMotion,
    target: Scalar,
    distance: Traffic,
) -> Scalar:
    """Return the acceleration behind the cars ahead, in this lane and in the target
    lane [m/s^2].
    """
    scene = situation.scene
    _, d, _, speed = car

    # Cars ahead between the robot and its target. A plan that passes an obstacle
    # ignores obstacles; other plans leave room before them to turn round them.
    lateral_gap = scene.reach[:, 1] + PASSING_GAP
    in_way = (traffic.d > jnp.minimum(d, target) - lateral_gap) & (
        traffic.d < jnp.maximum(d, target) + lateral_gap
    )
    in_way = in_way & (scene.moving | (plan.side == 0))
    turning_room = OBSTACLES.turning_room * (~scene.moving & (plan.lane == 1))
    contact = scene.reach[:, 0] + turning_room
    gap = jnp.where(
        (distance > 0) & in_way & scene.present, distance - contact, FREE_GAP
    )

    # Either follow by the Intelligent Driver Model ...
    following = ROBOT_IDM.acceleration(
        speed, SPEED.unlimited_speed, gap, traffic.forward_speed
    )
    following = SPEED.following_gain * following.min()

    # ... or drive at the highest speed from which gentle braking still suffices.
    room = gap - CLOSING_UP.gap - CLOSING_UP.reaction_time * speed
    gained = jnp.sqrt(2 * CLOSING_UP.braking * jnp.maximum(room, 0.0))
    safe_speed = traffic.forward_speed + gained
    closing_up = (safe_speed.min() - speed) / SPEED.preview
    return jnp.where(plan.closes_up, closing_up, following)


# The motion of the robot


def limited_control(
    planning: RoadPlanning, speed: Numbers, control: Control
) -> Control:
    """Limit the control to the friction circle, the largest curvature, and speeds from
    0.

    Braking has a share of the grip first, ``b = min(-a, share grip)``; then the
    curvature is limited, ``(v^2 k)^2 <= grip^2 - b^2``; then the acceleration, ``a^2 <=
    grip^2 - (v^2 k)^2``.
    """
    grip = planning.grip
    squared = jnp.maximum(speed, GRIP_USE.lowest_speed) ** 2

    braking = jnp.clip(-control[..., 1], 0.0, GRIP_USE.braking_share * grip)
    sharpest = jnp.minimum(planning.curvature, jnp.sqrt(grip**2 - braking**2) / squared)
    curvature = jnp.clip(control[..., 0], -sharpest, sharpest)

    left = jnp.sqrt(jnp.maximum(grip**2 - (squared * curvature) ** 2, 1e-6))
    acceleration = jnp.clip(control[..., 1], -left, left)
    acceleration = jnp.maximum(acceleration, -speed / planning.time_step)
    return jnp.stack([curvature, acceleration], axis=-1)


def advance(
    scene: RoadScene, planning: RoadPlanning, state: Car, wanted: Control
) -> tuple[Car, Control]:
    """Return the state one time step later, and the control within the grip.

    With the curvature k_r of the road in the middle of the step, and old values on the
    right-hand side::

        s += u cos(heading) dt / (1 - d k_r)
        d += u sin(heading - k_r s' frame / 2) dt
        heading += (v k - k_r s') dt
        v += a dt

    The speed v is that of the centre. Its slip angle is beta, ``sin(beta) = k length /
    2``, so the speed of the rear axle is ``u = v cos(beta)``.

    In each frame of the simulation, the car moves along its heading at the beginning of
    the frame. In a bend, the road turns meanwhile, so that the car is carried outwards
    by ``v^2 k_r frame / 2`` in a second unless it points inwards by as much.
    """
    control = limited_control(planning, state[3], wanted)
    curvature = control[0]
    acceleration = control[1]
    s, d, heading, speed = state
    dt = planning.time_step
    bend = interpolate(scene.route.curvature, s + 0.5 * speed * dt)

    # The speed u of the rear axle, and the speed s' along the road.
    slip_sine = curvature * scene.size[0] / 2
    rear_speed = speed * jnp.sqrt(jnp.maximum(1 - slip_sine**2, 0.1))
    s_rate = rear_speed * jnp.cos(heading) / jnp.maximum(1 - d * bend, 0.2)

    direction = heading - bend * s_rate * planning.lag
    d_rate = rear_speed * jnp.sin(direction)
    heading_rate = speed * curvature - bend * s_rate
    rates = jnp.stack([s_rate, d_rate, heading_rate, acceleration])
    return state + rates * dt, control


def bodies(scene: RoadScene, states: States) -> Pose:
    """Return x, y and heading of the robot's centre in world coordinates, half a length
    ahead of its rear axle.
    """
    x, y, along = scene.route.place(states[..., 0], states[..., 1])
    heading = along + states[..., 2]
    half = scene.size[0] / 2
    return x + half * jnp.cos(heading), y + half * jnp.sin(heading), heading


def earlier(first: Scalar, values: Steps) -> Steps:
    """Shift values by a step: the first value comes first, the last of the values is
    dropped.
    """
    first_column = jnp.full_like(values[..., :1], first)
    return jnp.concatenate([first_column, values[..., :-1]], axis=-1)
