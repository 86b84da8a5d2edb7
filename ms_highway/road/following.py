"""Predict the traffic: it keeps its speed, follows, or has given accelerations.

Those that follow do so by the Intelligent Driver Model. All others move together with
the robot's proposals, step by step, so that cars that follow respond to the robot.
"""

from dataclasses import dataclass
from typing import NamedTuple

from jax import numpy as jnp

from ms_highway.game.car_following import FREE_GAP, HIGHWAY_ENV_IDM, TRAFFIC_LIMITS
from ms_highway.perception.scene import (
    Flags,
    PerPathAndStep,
    Places,
    RoadScene,
    Steps,
    Traffic,
)
from ms_highway.road.traffic import COSINES, PASSING_GAP, Situation
from ms_highway.road.traffic_models import ModelNumber
from ms_highway.runtime.arrays import Car, Numbers


@dataclass(frozen=True)
class TrafficPrediction:
    """Set how others are expected to move."""

    path_time: float = 1.0
    """Time constant with which a car returns to the middle of its path [s]."""
    slow_share: float = 0.6
    """Share of the speed limit below which a car is expected to speed up to it."""
    rolling_speed: float = 0.3
    """Speed backwards above which a car may roll on; others stop at most [m/s]."""
    hard_braking: float = 3.0
    """Deceleration above which a car ahead is expected to brake on [m/s^2]."""
    braking_time: float = 3.0
    """Time for which it is expected to brake on [s]."""
    correction_time: float = 1.0
    """Time constant with which deviations from the model fade [s]."""


PREDICTION = TrafficPrediction()


class TrafficMotion(NamedTuple):
    """Where others are on their paths and on the robot's route, now or in each step.

    Attributes:
        along: positions on their own paths [m].
        s, d: positions on the robot's route [m].
        speed: along their paths [m/s].
        cosine: of the angle between their paths and the route.
    """

    along: PerPathAndStep
    s: PerPathAndStep
    d: PerPathAndStep
    speed: PerPathAndStep
    cosine: PerPathAndStep

    @property
    def forward_speed(self) -> Numbers:
        """Speeds in the direction of the robot's route [m/s]."""
        return self.speed * self.cosine

    @property
    def last(self) -> "TrafficMotion":
        """The motion after the last step."""
        return TrafficMotion(*(field[..., -1] for field in self))


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
    accelerations: PerPathAndStep
    residual: PerPathAndStep
    limit: PerPathAndStep


def behaviour_of(situation: Situation, models: Places, plans: int) -> Behaviour:
    """Return the behaviour of others that follow or keep their speed.

    Their models say which of both they do. Vehicles that may cross the robot's path
    keep their speed: at crossings, they do not only react to the car ahead. The part of
    an acceleration that the model does not explain fades; hard braking ahead of the
    robot goes on.
    """
    scene = situation.scene
    times = situation.planning.times
    follows = (models >= ModelNumber.idm) & scene.moving & ~situation.crossings.exist

    # The present acceleration that the model does not explain, fading.
    optimises = (models == ModelNumber.tom) & scene.moving
    is_modelled = follows | optimises
    modelled = jnp.where(is_modelled, present_accelerations(situation), 0.0)
    residual = scene.accelerations - modelled
    fading = jnp.exp(-times / PREDICTION.correction_time)

    # Cars ahead that brake hard brake on for some time.
    brakes_hard = situation.leading & (scene.accelerations < -PREDICTION.hard_braking)
    limit = jnp.where(brakes_hard, scene.accelerations, jnp.inf)[:, None]
    step_middle = times - situation.planning.time_step / 2
    limit = jnp.where(step_middle < PREDICTION.braking_time, limit, jnp.inf)

    return Behaviour(
        follows,
        accelerations=jnp.zeros((plans, len(models), len(times))),
        residual=residual[:, None] * fading,
        limit=limit,
    )


def positions_and_speeds(scene: RoadScene) -> tuple[Traffic, Traffic]:
    """Return positions and speeds of others along their paths now [m, m/s]."""
    s, _, heading, speed = jnp.asarray(scene.states).T
    return s, speed * jnp.where(scene.moving, 1.0, jnp.cos(heading))


def lateral_positions(scene: RoadScene, times: Steps) -> PerPathAndStep:
    """Return the lateral positions of others on their paths [traffic, steps].

    A car that drives returns to the middle of its path like a critically damped spring,
    ``d = (d_0 + (d_0' + d_0 / T) t) exp(-t / T)``. A crashed car slides along its
    heading and slows down by ``v' = -v``.
    """
    _, present, heading, speed = scene.states.T[..., None]
    lateral_speed = speed * jnp.sin(heading)
    rate = lateral_speed + present / PREDICTION.path_time
    returning = (present + rate * times) * jnp.exp(-times / PREDICTION.path_time)
    sliding = present + lateral_speed * (1 - jnp.exp(-times))
    return jnp.where(scene.moving[:, None], returning, sliding)


def traffic_motion(
    situation: Situation,
    along: Traffic,
    across: Traffic,
    speed: Traffic,
) -> TrafficMotion:
    """Return the motion of others at positions on their paths.

    Args:
        situation: what all plans share.
        along: positions along their paths [m].
        across: lateral positions on their paths [m].
        speed: along their paths [m/s].
    """
    s, d, cosine = situation.paths.at(along, across)
    return TrafficMotion(along, s, d, speed, cosine)


def follow_all(situation: Situation, traffic: TrafficMotion, robot: Car) -> Traffic:
    """Return the accelerations of others that follow the car ahead.

    They follow the car ahead on their path, and the robot in their lane. They desire
    their present speed, or the limit if they are much slower.

    Args:
        situation: what all plans share.
        traffic: where the others are.
        robot: state of the robot.
    """
    scene = situation.scene
    s, d, _, robot_speed = robot
    first_along, _, _, first_speed = jnp.asarray(scene.states).T
    is_slow = first_speed < PREDICTION.slow_share * scene.limits
    desired = jnp.where(is_slow, scene.limits, first_speed)

    # The gap to the leader on the same path changes by how far both have moved.
    moved = traffic.along - first_along
    present_gap = scene.gaps + moved[scene.leaders] - moved
    gap_to_leader = jnp.where(scene.leaders >= 0, present_gap, FREE_GAP)
    leader_speed = traffic.speed[scene.leaders]
    behind_leader = HIGHWAY_ENV_IDM.acceleration(
        traffic.speed, desired, gap_to_leader, leader_speed
    )

    # The gap to the robot, where it drives ahead in the same lane.
    distance = s + scene.size[0] / 2 - traffic.s
    in_lane = jnp.abs(traffic.d - d) < situation.contact[:, 1] + PASSING_GAP
    follows_robot = (distance > 0) & in_lane & (traffic.cosine > COSINES.follows)
    gap_to_robot = jnp.where(follows_robot, distance, FREE_GAP)
    behind_robot = HIGHWAY_ENV_IDM.acceleration(
        traffic.speed, desired, gap_to_robot, robot_speed
    )
    return jnp.minimum(behind_leader, behind_robot)


def present_accelerations(situation: Situation) -> Traffic:
    """Return the present accelerations by the Intelligent Driver Model.

    It is the least on all paths of a car.
    """
    scene = situation.scene
    along, across, _, speed = jnp.asarray(scene.states).T
    traffic = traffic_motion(situation, along, across, speed)
    on_each_path = follow_all(situation, traffic, jnp.asarray(scene.robot))
    is_same_car = scene.owners[:, None] == scene.owners  # [traffic, traffic]
    of_same_car = jnp.where(is_same_car, on_each_path, jnp.inf)
    least = of_same_car.min(axis=1)
    return jnp.maximum(least, -speed / situation.planning.time_step)


def move_traffic(
    situation: Situation,
    behaviour: Behaviour,
    rows: Steps,
    traffic: TrafficMotion,
    robot: Car,
) -> tuple[Traffic, Traffic]:
    """Return positions and speeds of others along their paths one time step later.

    Args:
        situation: what all plans share.
        behaviour: of the others.
        rows: their given accelerations, residuals and limits in this step [3, traffic].
        traffic: where the others are.
        robot: state of the robot.
    """
    scene = situation.scene
    dt = situation.planning.time_step
    given, residual, limit = rows

    following = follow_all(situation, traffic, robot)
    modelled = jnp.where(behaviour.follows, following, given)
    corrected = jnp.minimum(modelled + residual, limit)
    hardest = TRAFFIC_LIMITS.braking
    acceleration = jnp.clip(corrected, -hardest, hardest)

    # Crashed cars slide to a stop, v' = -v. Cars that roll backwards may roll on; the
    # others stop at most.
    acceleration = jnp.where(scene.moving, acceleration, -traffic.speed)
    _, first_speed = positions_and_speeds(scene)
    rolls = first_speed < -PREDICTION.rolling_speed
    lowest = jnp.where(rolls, -jnp.inf, -traffic.speed / dt)
    acceleration = jnp.maximum(acceleration, lowest)
    next_along = traffic.along + traffic.speed * dt
    next_speed = traffic.speed + acceleration * dt
    return next_along, next_speed
