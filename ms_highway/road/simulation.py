"""Simulate plans of the robot in traffic: its rear axle goes where it heads, as in highway-env."""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.geometry.curve import Curve, Pose, interpolate
from ms_highway.perception.scene import EachStep, RoadScene, States, Steps, Traffic, World
from ms_highway.planning.car_following import FREE_GAP, idm_acceleration, lowest
from ms_highway.road.constants import RoadPlanning
from ms_highway.road.following import Manners, along_paths, aside, move_traffic
from ms_highway.road.proposals import Profiles
from ms_highway.road.traffic import ROOM, WAITING, Situation
from ms_highway.runtime.arrays import Car, Control, Flag, ManyControls, Numbers, Scalar

LIMITED_SPEED = 1.0  # m/s, below which curvature is limited as at this speed
MAX_SLIP_SINE = 0.9  # sine of the slip angle at most
BRAKING_FIRST = 0.6  # share of the grip that the braking of plans may take before their steering
STEERING_FREQUENCY = 1.6  # rad/s, of the critically damped way to the centre of a lane
MAX_LATERAL_ACCELERATION = 3.0  # m/s^2, of lateral acceleration for it at most
STEERING_SPEED = 3.0  # m/s, below which steering is not sharper than at this speed
PREVIEW = 0.4  # s, ahead of which the speed in bends is looked up

COMFORT_GAIN = 0.8  # 1/s, acceleration per difference of speed
MAX_ACCELERATION = 3.0  # m/s^2, to the desired speed
FOLLOWING_GAIN = 2.0  # times the acceleration of the model of following that the robot takes
HEADWAY, STANDSTILL = 0.7, 2.0  # s and m, between bumpers, of the robot
CLOSE_BRAKING, CLOSE_GAP, CLOSE_REACTION = 2.0, 1.5, 0.25  # m/s^2, m, s, of closing up
CREEP_SPEED = 3.0  # m/s, at which crossing cars come that stand

TURNING_MARGIN = 4.0  # m, before what cannot move, that leave room to turn round it
LANE_CHANGE_GAP = 0.5  # m around others, within which a plan changes no lane
LANE_CHANGE_TIME = 3.0  # s before passing them, within which it does not, either


class DrivenPlans(NamedTuple):
    """Plans as they turn out.

    Attributes:
        states: of the robot after each step, road coordinates.
        controls: that it executed.
        path: trajectories of its centre.
        world: trajectories of others.
        along: positions of others on their paths after each step [m].
        s, d: of others on the robot's route [m].
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
        return self._replace(**{name: getattr(self, name)[..., -1] for name in self._fields[4:]})


def simulate(now: Situation, manners: Manners, plans: Profiles) -> DrivenPlans:
    """Drive plans among others who answer each of them."""
    scene, planning = now.scene, now.planning
    across, traffic = aside(scene, planning.times), along_paths(scene)

    def one(plan: Profiles, accelerations: EachStep) -> tuple:
        def go(carry: tuple, step: tuple) -> tuple[tuple, tuple]:
            (car, along, speeds), (held, sideways, orders) = carry, step
            where = now.ways.at(along, sideways)
            control = jnp.where(plan.given, held, _control(now, plan, car, along, where, speeds))
            ahead, control = advance(scene, planning, car, control)
            along, speeds = move_traffic(now, manners, orders, where, along, speeds, car)
            return (ahead, along, speeds), (ahead, control, along, speeds, *now.ways.at(along, sideways))

        orders = jnp.stack([accelerations, manners.surprise, manners.limit]).T.swapaxes(1, 2)
        return jax.lax.scan(go, (scene.robot, *traffic), (plan.controls, across.T, orders))[1]

    states, controls, *others = jax.vmap(one)(plans, manners.accelerations)
    along, speeds, s, d, cosine = (jnp.swapaxes(field, 1, 2) for field in others)
    x, y, heading = jax.vmap(Curve.place, (0, -2, 0), -2)(scene.paths, along, across)
    world = jnp.stack([x, y, heading + scene.askew - _slip(scene, along), speeds], axis=-2)
    path = jnp.stack([*bodies(scene, states), states[..., 3]], axis=-2)
    return DrivenPlans(states, controls, path, world, along, s, d, speeds, cosine)


def aim(now: Situation, plan: Profiles, s: Scalar) -> Scalar:
    """Return the lateral position that a plan goes to where its rear axle is at s."""
    passes = (plan.side != 0) & now.obstruction.exists & (s < now.obstruction.end)
    goal = interpolate(now.scene.lanes[plan.lane], s)
    return jnp.where(passes, now.obstruction.sides[(plan.side > 0).astype(int)], goal)


def _slip(scene: RoadScene, along: EachStep) -> EachStep:
    """Return the angles from the headings of others to their paths: centres that turn move aside of where cars head."""
    bends = jnp.where(scene.moving[:, None], jax.vmap(Curve.bend, (0, -2), -2)(scene.paths, along), 0.0)
    return jnp.arcsin(jnp.clip(bends * scene.sizes[:, :1] / 2, -MAX_SLIP_SINE, MAX_SLIP_SINE))


def _control(now: Situation, plan: Profiles, car: Car, along: Traffic, where: Pose, speeds: Traffic) -> Control:
    """Return the robot's control in a step of a plan."""
    scene, planning, crossings = now.scene, now.planning, now.crossings
    s, d, heading, speed = car
    onward, front = speeds * where[2], s + scene.size[0]
    ahead, apart = where[0] - (s + scene.size[0] / 2), scene.reach[:, 1] + ROOM
    target = aim(now, plan, s)
    goal = jnp.where(_waits(now, plan, car, target, where, onward), interpolate(scene.lanes[1], s), target)

    # towards its aim
    turn = interpolate(scene.route.curvature, s + 0.5 * speed * planning.time_step)
    back = -(STEERING_FREQUENCY**2) * (d - goal) - 2 * STEERING_FREQUENCY * speed * jnp.sin(heading)
    squared = jnp.maximum(speed, STEERING_SPEED) ** 2
    curvature = (
        turn / jnp.maximum(1 - d * turn, 0.2)
        + jnp.clip(back, -MAX_LATERAL_ACCELERATION, MAX_LATERAL_ACCELERATION) / squared
    )

    # slow enough for bends, and to wait for those who cross until they have passed; past its line, it goes
    lengths = scene.sizes[:, 0]
    arrival = jnp.maximum(crossings.begin - lengths / 2, 0.0) / jnp.maximum(scene.states[:, 3], CREEP_SPEED)
    awaited = scene.moving & (arrival < plan.yields) & (along < crossings.last + lengths / 2 + 1.0)
    left = crossings.line - front
    left = lowest(left, awaited & (left > -WAITING)) - PREVIEW * speed
    waiting = jnp.sqrt(2 * planning.stopping * planning.grip * jnp.maximum(left, 0.0))
    cap = jnp.minimum(interpolate(now.caps, s + PREVIEW * speed), waiting)

    # behind whoever is ahead, here or in the lane that the robot goes to
    beside = (where[1] > jnp.minimum(d, target) - apart) & (where[1] < jnp.maximum(d, target) + apart)
    beside = beside & (scene.moving | (plan.side == 0))
    room = scene.reach[:, 0] + TURNING_MARGIN * (~scene.moving & (plan.lane == 1))
    gap = jnp.where((ahead > 0) & beside & scene.present, ahead - room, FREE_GAP)
    safe = onward + jnp.sqrt(2 * CLOSE_BRAKING * jnp.maximum(gap - CLOSE_GAP - CLOSE_REACTION * speed, 0.0))
    kept = FOLLOWING_GAIN * idm_acceleration(speed, FREE_GAP, gap, onward, HEADWAY, STANDSTILL).min()
    kept = jnp.where(plan.closes, (safe.min() - speed) / PREVIEW, kept)

    free = COMFORT_GAIN * (jnp.minimum(cap, plan.share * planning.desired_speed) - speed)
    free = jnp.minimum(jnp.clip(free, -MAX_ACCELERATION, MAX_ACCELERATION), kept)
    acceleration = jnp.where(plan.follows, free, plan.rate)
    return jnp.stack([curvature, jnp.minimum(acceleration, jnp.maximum((cap - speed) / PREVIEW, -planning.grip))])


def _waits(now: Situation, plan: Profiles, car: Car, lane: Scalar, where: Pose, onward: Traffic) -> Flag:
    """Return whether a plan waits to change lanes, where others come towards the robot in its own.

    Plans that follow wait until they have dropped behind whoever is beside them, the others until they have overtaken;
    who is halfway there goes on.
    """
    scene, (s, d, _, speed) = now.scene, car
    ahead, apart = where[0] - s - scene.size[0] / 2, scene.reach[:, 1] + ROOM
    overtakes = ~plan.follows & (ahead > 0)
    passing = jnp.where(overtakes, LANE_CHANGE_TIME * jnp.maximum(speed - onward, 0.0), 0.0)
    inside = (jnp.abs(where[1] - lane) < apart) & (jnp.abs(d - lane) > apart) & scene.present
    beside = inside & (jnp.abs(ahead) < scene.reach[:, 0] + LANE_CHANGE_GAP + passing)
    return beside.any() & (now.crossings.come & (where[0] > s)).any()


def within_tyres(planning: RoadPlanning, speed: Numbers, control: Control) -> Control:
    """Limit curvature and acceleration to the friction circle, to the sharpest curve, and to a stop, never backwards.

    Braking takes up to a share of the grip first: ``b = min(-a, share grip)``. Then the curve: ``(v^2 k)^2 <= grip^2 -
    b^2``. Then all acceleration: ``a^2 <= grip^2 - (v^2 k)^2``.
    """
    squared = jnp.maximum(speed, LIMITED_SPEED) ** 2
    braking = jnp.clip(-control[..., 1], 0.0, BRAKING_FIRST * planning.grip)
    sharpest = jnp.minimum(planning.curvature, jnp.sqrt(planning.grip**2 - braking**2) / squared)
    curvature = jnp.clip(control[..., 0], -sharpest, sharpest)
    left = jnp.sqrt(jnp.maximum(planning.grip**2 - (squared * curvature) ** 2, 1e-6))
    acceleration = jnp.maximum(jnp.clip(control[..., 1], -left, left), -speed / planning.time_step)
    return jnp.stack([curvature, acceleration], axis=-1)


def advance(scene: RoadScene, planning: RoadPlanning, state: Car, wanted: Control) -> tuple[Car, Control]:
    """Return the state one time step later, and the control within tyres, see `within_tyres`.

    With old values on the right-hand side and the road's curvature k_r::

        s += u cos(heading) dt / (1 - d k_r);  d += u sin(heading) dt;  heading += (v k - k_r s') dt;  v += a dt

    The speed v is the centre's. With its slip angle beta, ``sin(beta) = k length / 2``, the rear axle moves with ``u =
    v cos(beta)``.
    """
    control = within_tyres(planning, state[3], wanted)
    s, d, heading, speed = state
    bend = interpolate(scene.route.curvature, s)
    rear = speed * jnp.sqrt(jnp.maximum(1 - (control[0] * scene.size[0] / 2) ** 2, 0.1))
    onward = rear * jnp.cos(heading) / jnp.maximum(1 - d * bend, 0.2)
    changes = [onward, rear * jnp.sin(heading), speed * control[0] - bend * onward, control[1]]
    return state + jnp.stack(changes) * planning.time_step, control


def bodies(scene: RoadScene, states: States) -> Pose:
    """Return x, y and heading of the robot's centre in world coordinates, half a length ahead of its rear axle."""
    x, y, along = scene.route.place(states[..., 0], states[..., 1])
    heading, half = along + states[..., 2], scene.size[0] / 2
    return x + half * jnp.cos(heading), y + half * jnp.sin(heading), heading


def earlier(first: Scalar, values: Steps) -> Steps:
    """Return values a step earlier, with a first one in front."""
    return jnp.concatenate([jnp.full_like(values[..., :1], first), values[..., :-1]], axis=-1)
