"""Propose plans: to lanes, by speed profiles, or round what cannot move, simulated against traffic that answers."""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.geometry.curve import Curve, Pose, interpolate
from ms_highway.planning.car_following import FAR, HARDEST, idm_acceleration, lowest
from ms_highway.road.arrays import EachStep, Lane, PlanFlags, Plans, States, World
from ms_highway.road.constants import STOPPING
from ms_highway.road.motion import RESERVED, SLIP, advance, within_tyres
from ms_highway.road.scene import LANES, Flags, RoadScene, Traffic
from ms_highway.road.traffic import (
    ROOM,
    WAITING,
    Situation,
    aside,
    desired_speeds,
    follow_all,
    on_route,
)
from ms_highway.runtime.arrays import Car, Control, Controls, Flag, Index, ManyControls, Scalar

STEADY = -5.0, -3.0, -1.5, 0.0, 1.5, 3.0  # m/s^2, of profiles of constant acceleration
YIELDING = 0.5, 1.5, 3.0, 5.0, np.inf  # s, of profiles that let cars pass who come until then
NEARLY = 0.3  # m, beside its way round what cannot move, up to which a robot is on it
SECONDS_ASIDE = 1.2  # s, that one that is not yet on it takes to what cannot move, at least
TURNING = 4.0  # m, before what cannot move, that leave room to turn round it
ROUND = 0.3, 0.6  # shares of the desired speed, in profiles that go round what cannot move
IN_EACH_LANE = (  # share of the desired speed, acceleration, whether it follows, and closes up as late as is safe
    (1.0, 0.0, True, False),
    (1.0, 0.0, True, True),
    *((1.0, acceleration, False, False) for acceleration in STEADY),
)
ALL = (
    *((lane, *profile, 0.0, 0, False) for lane in range(LANES) for profile in IN_EACH_LANE),
    *((lane, 1.0, min(STEADY), False, False, 0.0, 0, True) for lane in (0, LANES - 1)),
    *((1, 1.0, 0.0, True, False, seconds, 0, False) for seconds in YIELDING),
    *((1, share, 0.0, True, False, 0.0, side, False) for share in ROUND for side in (-1, 1)),
    (1, 1.0, 0.0, False, False, 0.0, 0, False),  # the rest of the last plan
)

PROPOSALS = len(ALL)
"""Number of proposals, the last plan among them."""

LAST_PLAN = PROPOSALS - 1
"""Number of the proposal that is the rest of the last plan."""

FULL_BRAKING = tuple(number for number, profile in enumerate(ALL) if profile[2] == min(STEADY))
"""Numbers of those that brake hardest."""

FREQUENCY = 1.6  # rad/s, of the critically damped way to the centre of a lane
SIDEWAYS = 3.0  # m/s^2, of lateral acceleration for it at most
EAGERNESS = 2.0  # times the acceleration of the model of following that the robot takes
CLOSE = 0.7, 2.0  # s and m, time gap and standstill gap of the robot
LATE, CLOSEST, REACTION = 2.0, 1.5, 0.25  # m/s^2, m, s, of closing up
HASTE = 3.0  # m/s^2, of accelerations for the desired speed
HURRY = 4.5  # m/s^2, of those of cars that cross others' ways, where time is short
SLOWEST = 3.0  # m/s, below which steering is not sharper than at this speed
PREVIEW = 0.4  # s, ahead of which the speed in bends is looked up
COMFORT_GAIN = 0.8  # 1/s, acceleration per difference of speed
CREEPING = 3.0  # m/s, at which cars come that stand
BACKWARDS = 0.3  # m/s, above which a car rolls backwards
FADES = 1.0  # s, in which others who do not do what their model says come back to it
CLEAR, OVERTAKING = 0.5, 3.0  # m around others and s before it passes them, in which a plan changes no lane
HELD = 3.0  # s, for which who brakes hard ahead goes on so


class Manners(NamedTuple):
    """How others move.

    Attributes:
        follows: whether each follows by the Intelligent Driver Model.
        given: whether its accelerations are given.
        accelerations: those, for every plan [m/s^2].
        surprise: what its last acceleration was above what its model says, which fades [m/s^2].
        held: its acceleration at most for `HELD` seconds [m/s^2].
    """

    follows: Flags
    given: Flags
    accelerations: EachStep
    surprise: Traffic
    held: Traffic


class Profiles(NamedTuple):
    """What plans do.

    Attributes:
        lane: that each goes to, 0 to 2.
        share: of the desired speed that it follows the traffic at.
        rate: its acceleration if it does not follow [m/s^2].
        follows: whether it follows the traffic.
        closes: whether it closes up as it follows.
        yields: it lets all cars pass that come to where they cross its route within this time [s].
        side: on which it goes round what cannot move in the robot's lane: -1, left; 1, right; 0, it does not.
        beyond: whether it goes on to the lane beyond.
        given: whether its controls are given.
        controls: those.
    """

    lane: Lane
    share: Plans
    rate: Plans
    follows: PlanFlags
    closes: PlanFlags
    yields: Plans
    side: Lane
    beyond: PlanFlags
    given: PlanFlags
    controls: ManyControls


class DrivenPlans(NamedTuple):
    """Plans as they turn out.

    Attributes:
        states: of the robot after each step, road coordinates.
        controls: that it executed.
        world: trajectories of others.
        along: positions of others on their paths after each step [m].
        s, d: of others on the robot's route [m].
        speeds: of others [m/s].
        cosine: of the angle between the others' paths and the route.
    """

    states: States
    controls: ManyControls
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


def profiles(last: Controls, last_lane: Index | int, last_side: Index | int) -> Profiles:
    """Return the profiles of all proposals: to lanes, yielding, round what cannot move, the rest of the last plan."""
    given, controls = jnp.arange(PROPOSALS) == LAST_PLAN, jnp.broadcast_to(last, (PROPOSALS, *last.shape))
    plans = Profiles._make([*map(jnp.asarray, zip(*ALL, strict=True)), given, controls])
    lane, side = jnp.where(given, last_lane, plans.lane), jnp.where(given, last_side, plans.side)
    return plans._replace(lane=lane, side=side)


def nearest_lane(scene: RoadScene, x: Scalar, y: Scalar) -> Index:
    """Return the lane whose centre is nearest to a place; the robot's own if that is NaN."""
    s, d, _ = scene.route.project(x, y, jnp.zeros(()))
    return jnp.where(jnp.isfinite(d), jnp.argmin(jnp.abs(interpolate(scene.lanes, s) - d)), 1)


def simulate_plans(now: Situation, manners: Manners, plans: Profiles) -> DrivenPlans:
    """Drive plans among others who answer each of them."""
    scene, planning, dt = now.scene, now.planning, now.planning.time_step
    half, wanted = scene.size[0] / 2, desired_speeds(scene)
    along, _, heading, speeds = jnp.asarray(scene.states).T
    speeds = speeds * jnp.where(scene.moving, 1.0, jnp.cos(heading))  # along the paths
    across, start = aside(scene, planning.times), (scene.robot, along, speeds)
    rolls = speeds < -BACKWARDS  # may go on so; others stop at most
    surprises = jnp.exp(-planning.times / FADES)[:, None] * manners.surprise
    most = jnp.where((planning.times - dt / 2 < HELD)[:, None], manners.held, jnp.inf)

    def one(plan: Profiles, order: EachStep) -> tuple:
        def go(carry: tuple, step: tuple) -> tuple[tuple, tuple]:
            (car, along, speeds), (held, sideways, ordered, surprise, limit) = carry, step
            where = on_route(now.ways, along, sideways)
            control = jnp.where(plan.given, held, _control(now, plan, car, along, where, speeds))
            control = within_tyres(planning, car[3], control, RESERVED)
            gaps = scene.gaps + along[scene.leaders] - along
            answer = follow_all(scene, wanted, where, speeds, gaps, (car[0] + half, car[1], car[3]))
            modelled = jnp.where(manners.given, ordered, jnp.where(manners.follows, answer, 0.0))
            acceleration = jnp.clip(jnp.minimum(modelled + surprise, limit), -HARDEST, HARDEST)
            acceleration = jnp.where(scene.moving, acceleration, -speeds)  # who has crashed slides to a stop
            acceleration = jnp.maximum(acceleration, jnp.where(rolls, -jnp.inf, -speeds / dt))
            moved, after = along + speeds * dt, speeds + acceleration * dt
            ahead = advance(scene, planning, car, control)
            return (ahead, moved, after), (ahead, control, moved, after, *on_route(now.ways, moved, sideways))

        return jax.lax.scan(go, start, (plan.controls, across.T, order.T, surprises, most))[1]

    states, controls, *others = jax.vmap(one)(plans, manners.accelerations)
    along, speeds, s, d, cosine = (jnp.swapaxes(field, 1, 2) for field in others)
    x, y, heading = jax.vmap(Curve.place, (0, -2, 0), -2)(scene.paths, along, across)
    world = jnp.stack([x, y, heading + scene.askew - _slip(scene, along), speeds], axis=-2)
    return DrivenPlans(states, controls, world, along, s, d, speeds, cosine)


def aim(now: Situation, plan: Profiles, s: Scalar) -> Scalar:
    """Return the lateral position that a plan goes to where its rear axle is at s."""
    passes = (plan.side != 0) & now.obstruction.exists & (s < now.obstruction.end)
    own, goal = (interpolate(now.scene.lanes[lane], s) for lane in (1, plan.lane))
    goal = jnp.where(plan.beyond, 2 * goal - own, goal)
    return jnp.where(passes, now.obstruction.sides[(plan.side > 0).astype(int)], goal)


def _slip(scene: RoadScene, along: EachStep) -> EachStep:
    """Return the angles from the headings of others to their paths: centres that turn move aside of where cars head."""
    bends = jnp.where(scene.moving[:, None], jax.vmap(Curve.bend, (0, -2), -2)(scene.paths, along), 0.0)
    return jnp.arcsin(jnp.clip(bends * scene.sizes[:, :1] / 2, -SLIP, SLIP))


def _control(now: Situation, plan: Profiles, car: Car, along: Traffic, where: Pose, speeds: Traffic) -> Control:
    """Return the robot's control in a step of a plan."""
    scene, planning = now.scene, now.planning
    s, d, heading, speed = car
    onward = speeds * where[2]
    front, apart = s + scene.size[0] / 2, scene.reach[:, 1] + ROOM
    target = aim(now, plan, s)
    goal = jnp.where(_waits(now, plan, car, target, where, onward), interpolate(scene.lanes[1], s), target)

    # towards its aim
    turn = interpolate(scene.route.curvature, s + 0.5 * speed * planning.time_step)
    back = -(FREQUENCY**2) * (d - goal) - 2 * FREQUENCY * speed * jnp.sin(heading)
    squared = jnp.maximum(speed, SLOWEST) ** 2
    curvature = turn / jnp.maximum(1 - d * turn, 0.2) + jnp.clip(back, -SIDEWAYS, SIDEWAYS) / squared

    # slow enough for bends, and to wait for those who cross until they have passed; past its line, it goes
    lengths = scene.sizes[:, 0]
    arrival = jnp.maximum(now.crossings.begin - lengths / 2, 0.0) / jnp.maximum(scene.states[:, 3], CREEPING)
    awaited = scene.present & scene.moving & (arrival < plan.yields) & (along < now.crossings.last + lengths / 2 + 1.0)
    left = now.crossings.line - (s + scene.size[0])
    left = lowest(left, awaited & (left > -WAITING)) - PREVIEW * speed
    cap = jnp.minimum(
        interpolate(now.caps, s + PREVIEW * speed), jnp.sqrt(2 * STOPPING * planning.grip * jnp.maximum(left, 0.0))
    )

    # slowly towards what cannot move, until the robot is aside of it
    ahead = jnp.maximum((now.obstruction.begin - s - scene.size[0]) / SECONDS_ASIDE, SLOWEST)
    slowly = (plan.side != 0) & (jnp.abs(d - target) > NEARLY) & (s + scene.size[0] < now.obstruction.begin)
    cap = jnp.where(slowly, jnp.minimum(cap, ahead), cap)

    # behind whoever is ahead, here or in the lane that the robot goes to
    beside = (where[1] > jnp.minimum(d, target) - apart) & (where[1] < jnp.maximum(d, target) + apart)
    beside = beside & (scene.moving | (plan.side == 0))
    room = scene.reach[:, 0] + TURNING * (~scene.moving & (plan.lane == 1))
    gap = jnp.where((where[0] > front) & beside & scene.present, where[0] - front - room, FAR)
    safe = onward + jnp.sqrt(2 * LATE * jnp.maximum(gap - CLOSEST - REACTION * speed, 0.0))
    kept = EAGERNESS * idm_acceleration(speed, FAR, gap, onward, *CLOSE).min()
    kept = jnp.where(plan.closes, (safe.min() - speed) / PREVIEW, kept)

    haste, gain = (jnp.where(plan.yields > 0, HURRY, other) for other in (HASTE, 1.0))
    free = gain * (COMFORT_GAIN * (jnp.minimum(cap, plan.share * planning.desired_speed) - speed))
    free = jnp.minimum(jnp.clip(free, -HASTE, haste), jnp.minimum(kept, haste))
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
    passing = jnp.where(overtakes, OVERTAKING * jnp.maximum(speed - onward, 0.0), 0.0)
    inside = (jnp.abs(where[1] - lane) < apart) & (jnp.abs(d - lane) > apart) & scene.present
    beside = inside & (jnp.abs(ahead) < scene.reach[:, 0] + CLEAR + passing)
    return beside.any() & (now.crossings.come & (where[0] > s)).any()
