"""Simulate plans of the robot in traffic: its rear axle moves along its heading, as in
highway-env.
"""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.car_following import FREE_GAP, ROBOT_IDM, TRAFFIC_LIMITS
from ms_highway.geometry.curve import SPACING, Curve, Pose, interpolate
from ms_highway.perception.scene import (
    EachStep,
    RoadScene,
    States,
    Steps,
    Traffic,
    World,
)
from ms_highway.road.constants import RoadPlanning
from ms_highway.road.following import Behaviour, along_paths, aside, move_traffic
from ms_highway.road.proposals import Profiles
from ms_highway.road.traffic import ROOM, WAITING, Situation, lowest
from ms_highway.runtime.arrays import Car, Control, ManyControls, Numbers, Scalar

LIMITED_SPEED = 1.0  # m/s, below which curvature is limited as at this speed
MAX_SLIP_SINE = 0.9  # largest sine of the slip angle
BRAKING_FIRST = 0.6  # share of the grip that braking may take before steering
STEERING_FREQUENCY = (
    1.6  # rad/s, of the critically damped motion to the centre of a lane
)
MAX_LATERAL_ACCELERATION = 3.0  # m/s^2, for this motion
STEERING_SPEED = 3.0  # m/s, below which steering is not sharper than at this speed
PREVIEW = 0.4  # s, that the robot looks ahead for speed limits

COMFORT_GAIN = 0.8  # 1/s, acceleration per difference of speed
FOLLOWING_GAIN = 2.0  # factor of the Intelligent Driver Model's acceleration
# m/s, so high that the robot behind a car accelerates as if nothing else limited it
UNLIMITED_SPEED = 1000.0
CLOSE_BRAKING, CLOSE_GAP, CLOSE_REACTION = 2.0, 1.5, 0.25  # m/s^2, m, s, of closing up
CREEP_SPEED = 3.0  # m/s, lowest speed at which crossing cars are expected to arrive

TURNING_MARGIN = 4.0  # m, of room before an obstacle to turn round it
LANE_CHANGE_GAP = (
    0.5  # m, to others beside the robot, below which a plan does not change lanes
)
LANE_CHANGE_TIME = (
    3.0  # s, before passing them, within which a plan does not change lanes either
)


class DrivenPlans(NamedTuple):
    """Simulated plans.

    Attributes:
        states: states of the robot after each step, in road coordinates.
        controls: executed controls of the robot.
        path: trajectories of the robot's centre.
        world: trajectories of others.
        along: positions of others on their paths after each step [m].
        s, d: positions of others on the robot's route [m].
        speeds: of others [m/s].
        cosine: of the angle between the others' paths and the route.
    """

    states: States
    controls: ManyControls
    path: World
    world: World
    along: EachStep
    s: EachStep
    d: EachStep
    speeds: EachStep
    cosine: EachStep

    @property
    def robot(self) -> EachStep:
        """States of the robot, [4, plans, 1, steps]."""
        return jnp.moveaxis(self.states[:, None], -1, 0)

    @property
    def end(self) -> "DrivenPlans":
        """Others after the last step."""
        return self._replace(
            **{name: getattr(self, name)[..., -1] for name in self._fields[4:]}
        )


def simulate(now: Situation, behaviour: Behaviour, plans: Profiles) -> DrivenPlans:
    """Simulate plans among others that respond to each of them."""
    scene = now.scene
    planning = now.planning
    across = aside(scene, planning.times)
    traffic = along_paths(scene)

    def one(plan: Profiles, accelerations: EachStep) -> tuple:
        def go(carry: tuple, step: tuple) -> tuple[tuple, tuple]:
            (car, along, speeds), (given, sideways, rows) = carry, step
            where = now.ways.at(along, sideways)
            control = jnp.where(
                plan.given, given, _control(now, plan, car, along, where, speeds)
            )
            ahead, control = advance(scene, planning, car, control)
            along, speeds = move_traffic(
                now, behaviour, rows, where, along, speeds, car
            )
            return (ahead, along, speeds), (
                ahead,
                control,
                along,
                speeds,
                *now.ways.at(along, sideways),
            )

        rows = jnp.stack(
            [accelerations, behaviour.residual, behaviour.limit]
        ).T.swapaxes(1, 2)
        return jax.lax.scan(
            go, (scene.robot, *traffic), (plan.controls, across.T, rows)
        )[1]

    states, controls, *others = jax.vmap(one)(plans, behaviour.accelerations)
    along, speeds, s, d, cosine = (jnp.swapaxes(field, 1, 2) for field in others)
    x, y, heading = jax.vmap(Curve.place, (0, -2, 0), -2)(scene.paths, along, across)
    world = jnp.stack(
        [x, y, heading + scene.askew - _slip(scene, along), speeds], axis=-2
    )
    path = jnp.stack([*bodies(scene, states), states[..., 3]], axis=-2)
    return DrivenPlans(states, controls, path, world, along, s, d, speeds, cosine)


def target_of(now: Situation, plan: Profiles, s: Scalar) -> Scalar:
    """Return the lateral position that a plan steers to where its rear axle is at s
    [m].
    """
    passes = (plan.side != 0) & now.obstruction.exists & (s < now.obstruction.end)
    goal = interpolate(now.scene.lanes[plan.lane], s)
    return jnp.where(passes, now.obstruction.sides[(plan.side > 0).astype(int)], goal)


def _slip(scene: RoadScene, along: EachStep) -> EachStep:
    """Return the slip angles of others: in bends, centres do not move along the
    heading.
    """
    bends = jnp.where(
        scene.moving[:, None],
        jax.vmap(Curve.bend, (0, -2), -2)(scene.paths, along),
        0.0,
    )
    return jnp.arcsin(
        jnp.clip(bends * scene.sizes[:, :1] / 2, -MAX_SLIP_SINE, MAX_SLIP_SINE)
    )


def _control(
    now: Situation,
    plan: Profiles,
    car: Car,
    along: Traffic,
    where: Pose,
    speeds: Traffic,
) -> Control:
    """Return the robot's control in a step of a plan."""
    scene = now.scene
    planning = now.planning
    crossings = now.crossings
    s, d, heading, speed = car
    onward = speeds * where[2]
    front = s + scene.size[0]
    ahead = where[0] - (s + scene.size[0] / 2)
    apart = scene.reach[:, 1] + ROOM
    target = target_of(now, plan, s)

    # If others come towards the robot in its lane, wait before changing lanes: plans
    # that follow, until they have dropped behind the cars beside them; other plans,
    # until they have overtaken them. Halfway into the lane, go on.
    overtakes = ~plan.follows & (ahead > 0)
    passing = jnp.where(
        overtakes, LANE_CHANGE_TIME * jnp.maximum(speed - onward, 0.0), 0.0
    )
    in_target_lane = (
        (jnp.abs(where[1] - target) < apart)
        & (jnp.abs(d - target) > apart)
        & scene.present
    )
    blocked = in_target_lane & (
        jnp.abs(ahead) < scene.reach[:, 0] + LANE_CHANGE_GAP + passing
    )
    waits = blocked.any() & (crossings.oncoming & (where[0] > s)).any()
    goal = jnp.where(waits, interpolate(scene.lanes[1], s), target)

    # Steer to the target. In a bend, the rear axle points inwards by half the turn of a
    # frame, see `advance`; in a sharp one, it is inside the target.
    turn = interpolate(scene.route.curvature, s + 0.5 * speed * planning.time_step)
    inside = interpolate(now.inside, s)
    slant = (interpolate(now.inside, s + SPACING) - inside) / SPACING
    turned = heading - slant - turn * speed * planning.lag
    back = -(STEERING_FREQUENCY**2) * (
        d - inside - goal
    ) - 2 * STEERING_FREQUENCY * speed * jnp.sin(turned)
    squared = jnp.maximum(speed, STEERING_SPEED) ** 2
    curvature = (
        turn / jnp.maximum(1 - d * turn, 0.2)
        + jnp.clip(back, -MAX_LATERAL_ACCELERATION, MAX_LATERAL_ACCELERATION) / squared
    )

    # Slow down for bends, and wait for crossing cars until they have passed; past the
    # waiting line, go on.
    lengths = scene.sizes[:, 0]
    arrival = jnp.maximum(crossings.begin - lengths / 2, 0.0) / jnp.maximum(
        scene.states[:, 3], CREEP_SPEED
    )
    awaited = (
        scene.moving
        & (arrival < plan.yields)
        & (along < crossings.last + lengths / 2 + 1.0)
    )
    left = crossings.line - front
    left = lowest(left, awaited & (left > -WAITING)) - PREVIEW * speed
    waiting = jnp.sqrt(2 * planning.stopping * planning.grip * jnp.maximum(left, 0.0))
    cap = jnp.minimum(interpolate(now.caps, s + PREVIEW * speed), waiting)

    # Keep behind the cars ahead, in this lane and in the target lane.
    beside = (where[1] > jnp.minimum(d, target) - apart) & (
        where[1] < jnp.maximum(d, target) + apart
    )
    beside = beside & (scene.moving | (plan.side == 0))
    room = scene.reach[:, 0] + TURNING_MARGIN * (~scene.moving & (plan.lane == 1))
    gap = jnp.where((ahead > 0) & beside & scene.present, ahead - room, FREE_GAP)
    safe = onward + jnp.sqrt(
        2 * CLOSE_BRAKING * jnp.maximum(gap - CLOSE_GAP - CLOSE_REACTION * speed, 0.0)
    )
    followed = ROBOT_IDM.acceleration(speed, UNLIMITED_SPEED, gap, onward)
    kept = FOLLOWING_GAIN * followed.min()
    kept = jnp.where(plan.closes, (safe.min() - speed) / PREVIEW, kept)

    free = COMFORT_GAIN * (
        jnp.minimum(cap, plan.share * planning.desired_speed) - speed
    )
    comfort = TRAFFIC_LIMITS.acceleration
    free = jnp.minimum(jnp.clip(free, -comfort, comfort), kept)
    acceleration = jnp.where(plan.follows, free, plan.rate)
    return jnp.stack(
        [
            curvature,
            jnp.minimum(
                acceleration, jnp.maximum((cap - speed) / PREVIEW, -planning.grip)
            ),
        ]
    )


def limited_control(
    planning: RoadPlanning, speed: Numbers, control: Control
) -> Control:
    """Limit the control to the friction circle, the largest curvature, and speeds from
    0.

    Braking has a share of the grip first, ``b = min(-a, share grip)``; then the
    curvature is limited, ``(v^2 k)^2 <= grip^2 - b^2``; then the acceleration, ``a^2 <=
    grip^2 - (v^2 k)^2``.
    """
    squared = jnp.maximum(speed, LIMITED_SPEED) ** 2
    braking = jnp.clip(-control[..., 1], 0.0, BRAKING_FIRST * planning.grip)
    sharpest = jnp.minimum(
        planning.curvature, jnp.sqrt(planning.grip**2 - braking**2) / squared
    )
    curvature = jnp.clip(control[..., 0], -sharpest, sharpest)
    left = jnp.sqrt(jnp.maximum(planning.grip**2 - (squared * curvature) ** 2, 1e-6))
    acceleration = jnp.maximum(
        jnp.clip(control[..., 1], -left, left), -speed / planning.time_step
    )
    return jnp.stack([curvature, acceleration], axis=-1)


def advance(
    scene: RoadScene, planning: RoadPlanning, state: Car, wanted: Control
) -> tuple[Car, Control]:
    """Return the state one time step later, and the control within the grip, see `limited_control`.

    With the curvature k_r of the road in the middle of the step, and old values on the
    right-hand side::

        s += u cos(heading) dt / (1 - d k_r);  d += u sin(heading - k_r s' frame / 2) dt
        heading += (v k - k_r s') dt;          v += a dt

    The speed v is that of the centre. Its slip angle is beta, ``sin(beta) = k length /
    2``, so the speed of the rear axle is ``u = v cos(beta)``.

    In each frame of the simulation, the car moves along its heading at the beginning of
    the frame. In a bend, the road turns meanwhile, so that the car is carried outwards by
    ``v^2 k_r frame / 2`` in a second unless it points inwards by as much.
    """
    control = limited_control(planning, state[3], wanted)
    s, d, heading, speed = state
    dt = planning.time_step
    bend = interpolate(scene.route.curvature, s + 0.5 * speed * dt)
    rear = speed * jnp.sqrt(jnp.maximum(1 - (control[0] * scene.size[0] / 2) ** 2, 0.1))
    onward = rear * jnp.cos(heading) / jnp.maximum(1 - d * bend, 0.2)
    direction = heading - bend * onward * planning.lag
    changes = [
        onward,
        rear * jnp.sin(direction),
        speed * control[0] - bend * onward,
        control[1],
    ]
    return state + jnp.stack(changes) * dt, control


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
    return jnp.concatenate(
        [jnp.full_like(values[..., :1], first), values[..., :-1]], axis=-1
    )
