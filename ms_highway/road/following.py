"""Move the traffic: it keeps its speed, follows by the Intelligent Driver Model, or has
given accelerations.

All others move together with the robot's proposals, step by step, so that cars that
follow respond to the robot.
"""

from typing import NamedTuple

from jax import numpy as jnp

from ms_highway.game.car_following import FREE_GAP, HIGHWAY_ENV_IDM, TRAFFIC_LIMITS
from ms_highway.geometry.curve import Pose
from ms_highway.perception.scene import (
    EachStep,
    Flags,
    Places,
    RoadScene,
    Steps,
    Traffic,
)
from ms_highway.road.constants import IDM, TOM
from ms_highway.road.traffic import ROOM, Situation
from ms_highway.runtime.arrays import Car

SAME_WAY_COSINE = (
    0.7  # cosine of the angle between paths above which a car follows the robot ahead
)
PATH_TIME = 1.0  # s, time constant of the way back to the middle of the path
# share of the speed limit below which cars are expected to speed up to the limit
SLOW_SHARE = 0.6
REVERSING_SPEED = 0.3  # m/s, above which a car rolls backwards
HARD_BRAKING, BRAKING_TIME = (
    3.0,
    3.0,
)  # m/s^2 and s: a car ahead that brakes harder is expected to brake on so long
CORRECTION_TIME = 1.0  # s, time constant with which deviations from the model fade


class Behaviour(NamedTuple):
    """How others move.

    Attributes:
        follows: whether each follows by the Intelligent Driver Model.
        accelerations: of those that do not follow, under each plan [m/s^2].
        residual: excess of the last acceleration over the model's; it fades from step
            to step [m/s^2].
        limit: upper bound of the acceleration in each step [m/s^2].
    """

    follows: Flags
    accelerations: EachStep
    residual: EachStep
    limit: EachStep


def behaviour_of(now: Situation, models: Places, plans: int) -> Behaviour:
    """Return the behaviour of others that follow or keep their speed, as their models
    say.

    Vehicles that may cross the robot's path keep their speed: at crossings, they do not
    only react to the car ahead. The part of an acceleration that the model does not
    explain fades; hard braking ahead of the robot goes on.
    """
    scene = now.scene
    times = now.planning.times
    follows = (models >= IDM) & scene.moving & ~now.crossings.exist
    expected = follows | ((models == TOM) & scene.moving)
    residual = scene.accelerations - jnp.where(expected, accelerations_now(now), 0.0)
    limit = jnp.where(
        now.leading & (scene.accelerations < -HARD_BRAKING),
        scene.accelerations,
        jnp.inf,
    )[:, None]
    return Behaviour(
        follows,
        accelerations=jnp.zeros((plans, len(models), len(times))),
        residual=residual[:, None] * jnp.exp(-times / CORRECTION_TIME),
        limit=jnp.where(
            times - now.planning.time_step / 2 < BRAKING_TIME, limit, jnp.inf
        ),
    )


def along_paths(scene: RoadScene) -> tuple[Traffic, Traffic]:
    """Return positions and speeds of others along their paths now [m, m/s]."""
    s, _, heading, speed = jnp.asarray(scene.states).T
    return s, speed * jnp.where(scene.moving, 1.0, jnp.cos(heading))


def aside(scene: RoadScene, times: Steps) -> EachStep:
    """Return the lateral positions of others on their paths; cars that drive return to
    the middle.

    A crashed car slides along its heading and slows down by ``v' = -v``.
    """
    _, now, heading, speed = scene.states.T[..., None]
    sideways = speed * jnp.sin(heading)
    settles = (now + (sideways + now / PATH_TIME) * times) * jnp.exp(-times / PATH_TIME)
    return jnp.where(
        scene.moving[:, None], settles, now + sideways * (1 - jnp.exp(-times))
    )


def follow_all(
    now: Situation, where: Pose, along: Traffic, speeds: Traffic, robot: Car
) -> Traffic:
    """Return the accelerations of others that follow the car ahead on their path, and
    the robot in their lane.

    They desire their present speed, or the limit if they are much slower.

    Args:
        now: the situation.
        where: positions of the others, see `ms_highway.road.traffic.Ways.at`.
        along: positions of the others on their paths [m].
        speeds: of the others [m/s].
        robot: state of the robot.
    """
    scene, (s, d, _, speed) = now.scene, robot
    first, _, _, desired = jnp.asarray(scene.states).T
    desired = jnp.where(desired < SLOW_SHARE * scene.limits, scene.limits, desired)
    moved = along - first
    ahead = s + scene.size[0] / 2 - where[0]
    gaps = jnp.where(
        scene.leaders >= 0, scene.gaps + moved[scene.leaders] - moved, FREE_GAP
    )
    in_lane = jnp.abs(where[1] - d) < scene.reach[:, 1] + ROOM
    behind = jnp.where(
        (ahead > 0) & in_lane & (where[2] > SAME_WAY_COSINE), ahead, FREE_GAP
    )
    idm = HIGHWAY_ENV_IDM
    by_leader = idm.acceleration(speeds, desired, gaps, speeds[scene.leaders])
    by_robot = idm.acceleration(speeds, desired, behind, speed)
    return jnp.minimum(by_leader, by_robot)


def accelerations_now(now: Situation) -> Traffic:
    """Return the present accelerations by the Intelligent Driver Model: the least on
    all paths of a car.
    """
    scene, (along, across, _, speeds) = now.scene, jnp.asarray(now.scene.states).T
    each = follow_all(
        now, now.ways.at(along, across), along, speeds, jnp.asarray(scene.robot)
    )
    same = scene.owners[:, None] == scene.owners
    return jnp.maximum(
        jnp.where(same, each, jnp.inf).min(axis=1), -speeds / now.planning.time_step
    )


def move_traffic(
    now: Situation,
    behaviour: Behaviour,
    rows: Steps,
    where: Pose,
    along: Traffic,
    speeds: Traffic,
    robot: Car,
) -> tuple[Traffic, Traffic]:
    """Return positions and speeds of others along their paths one time step later.

    Args:
        now: the situation.
        behaviour: of the others.
        rows: their given accelerations, residuals and limits in this step [3, traffic].
        where: see `follow_all`.
        along: see `follow_all`.
        speeds: see `follow_all`.
        robot: see `follow_all`.
    """
    (given, residual, limit), dt = rows, now.planning.time_step
    modelled = jnp.where(
        behaviour.follows, follow_all(now, where, along, speeds, robot), given
    )
    hardest = TRAFFIC_LIMITS.braking
    acceleration = jnp.minimum(modelled + residual, limit)
    acceleration = jnp.clip(acceleration, -hardest, hardest)
    acceleration = jnp.where(
        now.scene.moving, acceleration, -speeds
    )  # crashed cars slide to a stop
    rolls = (
        along_paths(now.scene)[1] < -REVERSING_SPEED
    )  # these may roll on; the others stop at most
    acceleration = jnp.maximum(acceleration, jnp.where(rolls, -jnp.inf, -speeds / dt))
    return along + speeds * dt, speeds + acceleration * dt
