"""Propose plans: to the centre of each lane, by speed profiles, simulated against traffic that answers."""

from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.road import LANES, SPACING, RoadScene, interpolate
from ms_highway.planning.road.motion import advance, within_limits
from ms_highway.planning.road.settings import CORNERING, RoadPlanning
from ms_highway.planning.road.traffic import (
    FAR,
    ROOM,
    Crossings,
    Ways,
    aside,
    crossings,
    follow,
    gaps_to_robot,
    headways,
    on_route,
    wanted_speeds,
)

__all__ = [
    "FULL_BRAKING",
    "PROPOSALS",
    "STOPPING",
    "Manners",
    "Profiles",
    "Rollouts",
    "as_given",
    "profiles",
    "simulate",
    "speed_caps",
    "waiting_lines",
]

FOLLOWING = np.array([1.0, 0.75, 0.5, 0.25], np.float32)  # shares of the desired speed, in profiles that follow by IDM
STEADY = np.array([-5.0, -3.0, -1.5, 0.0, 1.5, 3.0], np.float32)  # m/s^2, of profiles of constant acceleration
CLOSING_UP = 1  # profiles that close up to the car ahead as late and as far as is safe
PROFILES = len(FOLLOWING) + CLOSING_UP + len(STEADY)
YIELDING = np.array([0.5, 1.5, 3.0, 5.0, np.inf], np.float32)  # s, of profiles that let cars pass who come until then
PROPOSALS = LANES * PROFILES + len(YIELDING) + 1
"""Number of proposals, the last plan among them."""

FULL_BRAKING = tuple(lane * PROFILES + len(FOLLOWING) + CLOSING_UP for lane in range(LANES))
"""Numbers of those that brake hardest."""

FREQUENCY = 1.6  # rad/s, of the critically damped way to the centre of a lane
SIDEWAYS = 3.0  # m/s^2, of lateral acceleration for it at most
SLOWING = 2.5  # m/s^2, before bends
EAGERNESS = 2.0  # times the acceleration of the model of following that the robot takes
CLOSE = 0.7, 2.0  # s and m, time gap and standstill gap of the robot
LATE, CLOSEST, REACTION = 2.0, 1.5, 0.25  # m/s^2, m, s, of closing up
HASTE = 3.0  # m/s^2, of accelerations for the desired speed
HURRY = 4.5  # m/s^2, of those of cars that cross others' ways, where time is short
SLOWEST = 3.0  # m/s, below which steering is not sharper than at this speed
PREVIEW = 0.4  # s, ahead of which the speed in bends is looked up
COMFORT_GAIN = 0.8  # 1/s, acceleration per difference of speed
WAITING = 1.2  # m, between the robot that waits and those who cross
CREEPING = 3.0  # m/s, at which cars come that stand

STOPPING = 3.5
"""Deceleration before crossings [m/s^2]."""


class Manners(NamedTuple):
    """How others move.

    Attributes:
        follows: whether each follows by the Intelligent Driver Model.
        told: whether its accelerations are given.
        accelerations: those, for every plan [m/s^2].
    """

    follows: Bool[jax.Array, "traffic"]
    told: Bool[jax.Array, "traffic"]
    accelerations: Float[jax.Array, "plans traffic steps"]


class Profiles(NamedTuple):
    """What plans do.

    Attributes:
        lane: that each goes to, 0 to 2.
        share: of the desired speed that it follows the traffic at.
        rate: its acceleration if it does not follow [m/s^2].
        follows: whether it follows the traffic.
        closes: whether it closes up as it follows.
        yields: it lets all cars pass that come to where they cross its route within this time [s].
        given: whether its controls are given.
        controls: those.
    """

    lane: Int[jax.Array, "plans"]
    share: Float[jax.Array, "plans"]
    rate: Float[jax.Array, "plans"]
    follows: Bool[jax.Array, "plans"]
    closes: Bool[jax.Array, "plans"]
    yields: Float[jax.Array, "plans"]
    given: Bool[jax.Array, "plans"]
    controls: Float[jax.Array, "plans steps 2"]


class Rollouts(NamedTuple):
    """Plans as they turn out.

    Attributes:
        states: of the robot after each step, road coordinates.
        controls: that it executed.
        along, across: positions of others on their paths after each step [m].
        speeds: of others [m/s].
        s, d: of others on the robot's route [m].
        cosine: of the angle between the others' paths and the route.
    """

    states: Float[jax.Array, "plans steps 4"]
    controls: Float[jax.Array, "plans steps 2"]
    along: Float[jax.Array, "plans traffic steps"]
    across: Float[jax.Array, "plans traffic steps"]
    speeds: Float[jax.Array, "plans traffic steps"]
    s: Float[jax.Array, "plans traffic steps"]
    d: Float[jax.Array, "plans traffic steps"]
    cosine: Float[jax.Array, "plans traffic steps"]


def speed_caps(scene: RoadScene, planning: RoadPlanning) -> Float[jax.Array, "knots"]:
    """Return the highest speed at each knot of the route from which gentle braking suffices for all bends ahead."""
    bends = jnp.maximum(jnp.abs(jnp.asarray(scene.route.curvature)), 1e-4)
    allowed = jnp.minimum(CORNERING * planning.grip / bends, planning.desired_speed**2)
    ahead = 2 * SLOWING * SPACING * jnp.arange(len(bends))
    return jnp.sqrt(jnp.maximum(jax.lax.cummin(allowed + ahead, reverse=True) - ahead, 1.0))


def waiting_lines(scene: RoadScene, crossing: Crossings) -> Float[jax.Array, "traffic"]:
    """Return the places on the route where the front of the robot waits for those who cross it [m]."""
    return crossing.first - jnp.asarray(scene.sizes)[:, 1] / 2 - WAITING


def profiles(last: Float[jax.Array, "steps 2"], last_lane: Int[jax.Array, ""]) -> Profiles:
    """Return the profiles of all proposals: each lane at each speed, and the rest of the last plan."""
    lanes, kinds = np.divmod(np.arange(LANES * PROFILES), PROFILES)
    following = len(FOLLOWING) + CLOSING_UP
    shares, rates = np.append(FOLLOWING, np.ones(PROFILES - len(FOLLOWING))), np.append(np.zeros(following), STEADY)
    own, ones = np.ones(len(YIELDING), int), np.ones(len(YIELDING), np.float32)
    return Profiles(
        jnp.concatenate([lanes, own, jnp.asarray(last_lane)[None]]),
        jnp.concatenate([shares[kinds], ones, jnp.ones(1)]),
        jnp.concatenate([rates[kinds], 0 * ones, jnp.zeros(1)]),
        jnp.concatenate([kinds < following, ones > 0, jnp.zeros(1, bool)]),
        jnp.concatenate([(kinds >= len(FOLLOWING)) & (kinds < following), ones < 0, jnp.zeros(1, bool)]),
        jnp.concatenate([np.zeros(len(kinds), np.float32), YIELDING, jnp.zeros(1)]),
        jnp.arange(PROPOSALS) == PROPOSALS - 1,
        jnp.broadcast_to(last, (PROPOSALS, *last.shape)),
    )


def as_given(controls: Float[jax.Array, "plans steps 2"], lane: Int[jax.Array, "plans"]) -> Profiles:
    """Return the profiles of plans whose controls are given."""
    ones = jnp.ones(len(controls))
    return Profiles(lane, ones, 0 * ones, ones < 0, ones < 0, 0 * ones, ones > 0, controls)


def simulate(
    scene: RoadScene,
    planning: RoadPlanning,
    ways: Ways,
    caps: Float[jax.Array, "knots"],
    manners: Manners,
    plans: Profiles,
) -> Rollouts:
    """Drive plans among others who answer each of them.

    Args:
        scene: the road.
        planning: limits and wishes.
        ways: `ms_highway.planning.road.traffic.ways_of` the scene.
        caps: `speed_caps` of the route.
        manners: how others move.
        plans: what the robot does.
    """
    wanted, headway, now = wanted_speeds(scene), headways(scene), jnp.asarray(scene.states)
    across = aside(scene, jnp.arange(1, planning.steps + 1) * jnp.asarray(planning.time_step))
    length, width = scene.size
    lengths, widths = jnp.asarray(scene.sizes).T
    apart, reach = (width + widths) / 2 + ROOM, (length + lengths) / 2
    leaders, present = jnp.asarray(scene.leaders), jnp.asarray(scene.present)
    led = (leaders >= 0) & present
    crossing = crossings(ways)
    line = waiting_lines(scene, crossing)
    arrival = jnp.maximum(crossing.begin - lengths / 2, 0.0) / jnp.maximum(now[:, 3], CREEPING)
    crosses = present & jnp.asarray(scene.moving)

    def steer(car: jax.Array, goal: jax.Array) -> jax.Array:
        """Return the curvature towards the centre of a lane."""
        s, d, heading, speed = car
        bend = interpolate(scene.route.curvature, s + 0.5 * speed * planning.time_step)
        back = -(FREQUENCY**2) * (d - goal) - 2 * FREQUENCY * speed * jnp.sin(heading)
        squared = jnp.maximum(speed, SLOWEST) ** 2
        return bend / jnp.maximum(1 - d * bend, 0.2) + jnp.clip(back, -SIDEWAYS, SIDEWAYS) / squared

    def behind_leader(plan: Profiles, car: jax.Array, goal: jax.Array, traffic: tuple[jax.Array, ...]) -> jax.Array:
        """Return the acceleration of following whoever is ahead, here or in the lane that the robot goes to."""
        (s, d, _, speed), (others_s, others_d, cosine, speeds) = car, traffic
        front = s + length / 2
        low, high = jnp.minimum(d, goal), jnp.maximum(d, goal)
        ahead = (others_s > front) & (others_d > low - apart) & (others_d < high + apart) & present
        gap = jnp.where(ahead, others_s - front - reach, FAR)
        onward = speeds * cosine
        safe = onward + jnp.sqrt(2 * LATE * jnp.maximum(gap - CLOSEST - REACTION * speed, 0.0))
        close = (safe.min() - speed) / PREVIEW
        kept = EAGERNESS * follow(speed, FAR, gap, onward, *CLOSE).min()
        return jnp.minimum(jnp.where(plan.closes, close, kept), jnp.where(plan.yields > 0, HURRY, HASTE))

    def before_crossing(plan: Profiles, car: jax.Array, along: jax.Array) -> jax.Array:
        """Return the speed that allows to wait for those who cross, until they have passed; past its line, it goes."""
        awaited = crosses & (arrival < plan.yields) & (along < crossing.last + lengths / 2 + 1.0)
        left = line - (car[0] + length)
        left = jnp.where(awaited & (left > -WAITING), left, FAR).min() - PREVIEW * car[3]
        return jnp.sqrt(2 * STOPPING * jnp.maximum(left, 0.0))

    def choose(
        plan: Profiles, car: jax.Array, held: jax.Array, along: jax.Array, traffic: tuple[jax.Array, ...]
    ) -> jax.Array:
        """Return the robot's control in a step of a plan."""
        s, speed = car[0], car[3]
        goal = interpolate(jnp.asarray(scene.lanes)[plan.lane], s)
        cap = jnp.minimum(interpolate(caps, s + PREVIEW * speed), before_crossing(plan, car, along))
        free = COMFORT_GAIN * (jnp.minimum(cap, plan.share * planning.desired_speed) - speed)
        free = jnp.clip(jnp.where(plan.yields > 0, HURRY, 1.0) * free, -HASTE, jnp.where(plan.yields > 0, HURRY, HASTE))
        kept = jnp.minimum(free, behind_leader(plan, car, goal, traffic))
        acceleration = jnp.where(plan.follows, kept, plan.rate)
        acceleration = jnp.minimum(acceleration, jnp.maximum((cap - speed) / PREVIEW, -planning.grip))
        told = jnp.stack([steer(car, goal), acceleration])
        return within_limits(planning, speed, jnp.where(plan.given, held, told))

    def one(plan: Profiles, order: Float[jax.Array, "traffic steps"]) -> tuple[jax.Array, ...]:
        def go(carry: tuple[jax.Array, ...], step: tuple[jax.Array, ...]) -> tuple[tuple, tuple]:
            (car, along, speeds), (held, sideways, told) = carry, step
            where = on_route(ways, along, sideways)
            control = choose(plan, car, held, along, (*where, speeds))
            gap = jnp.where(led, jnp.asarray(scene.gaps) + along[leaders] - along, FAR)
            to_robot = gaps_to_robot(car[0] + length / 2, car[1], where, apart)
            answer = jnp.minimum(
                follow(speeds, wanted, gap, speeds[leaders], headway),
                follow(speeds, wanted, to_robot, car[3], headway),
            )
            unanswered = jnp.where(scene.moving, 0.0, -speeds)  # who has crashed slides to a stop
            acceleration = jnp.where(manners.told, told, jnp.where(manners.follows, answer, unanswered))
            acceleration = jnp.where(speeds < 0, 0.0, jnp.maximum(acceleration, -speeds / planning.time_step))
            moved = along + speeds * planning.time_step
            after = speeds + acceleration * planning.time_step
            ahead = advance(scene, planning, car, control)
            return (ahead, moved, after), (ahead, control, moved, after, *on_route(ways, moved, sideways))

        start = jnp.asarray(scene.robot), now[:, 0], now[:, 3]
        return jax.lax.scan(go, start, (plan.controls, across.T, order.T))[1]

    states, controls, *others = jax.vmap(one)(plans, manners.accelerations)
    along, speeds, s, d, cosine = (jnp.swapaxes(field, 1, 2) for field in others)
    return Rollouts(states, controls, along, jnp.broadcast_to(across, along.shape), speeds, s, d, cosine)
