"""Adapt highway-env's own environments to the robot.

Read their goals and desired speeds, replace their car, and undo their side effects.
"""

from collections.abc import Callable

import gymnasium as gym
from highway_env.envs import ExitEnv, IntersectionEnv, MergeEnv, RoundaboutEnv, UTurnEnv
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import MultiAgentAction
from highway_env.envs.common.observation import MultiAgentObservation
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.graphics import VehicleGraphics
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.game.car_following import HIGHWAY_ENV_IDM
from ms_highway.road.timed_goal import RobotGoal

DESTINATIONS = {RoundaboutEnv: "nxs", ExitEnv: "exit", UTurnEnv: "d"}
"""Node where the robot drives in environments whose car has no route."""


class GoalEnv:
    """Base of environments that define the goal of the robot that drives their car.

    Attributes:
        goal: of the robot; None without one.
        desired_speed: of the robot without a goal in time [m/s].
        success: whether the goal has been reached.
    """

    goal: RobotGoal
    desired_speed: float
    success: bool


def destination_of(env: gym.Env, number: int = 0) -> RobotGoal:
    """Return the goal of a controlled vehicle, None without one.

    Args:
        env: a highway-env environment, or a wrapper of one, after a reset.
        number: of the controlled vehicle.
    """
    base: AbstractEnv = env.unwrapped
    if isinstance(base, GoalEnv):
        return base.goal
    if isinstance(base, IntersectionEnv):
        route = getattr(base.controlled_vehicles[number], "route", None) or []
        if len(route) > 1:
            return route[-1][1]
        return base.config["destination"] if number == 0 else None
    for kind, node in DESTINATIONS.items():
        if isinstance(base, kind):
            return node
    return None


def desired_speed_of(env: gym.Env) -> float:
    """Return the speed that an environment rewards most [m/s].

    In an intersection it is the speed limit; a `GoalEnv` defines it.
    """
    base: AbstractEnv = env.unwrapped
    if isinstance(base, GoalEnv):
        return base.desired_speed
    if isinstance(base, IntersectionEnv):
        # 9 m/s are rewarded, but take longer than 13 s.
        return float(base.vehicle.lane.speed_limit)
    config = base.config
    action = config["action"].get("action_config", config["action"])
    speeds = config.get("reward_speed_range") or action.get("target_speeds")
    if speeds is None:
        usual_speed = 30.0  # where the scene says nothing
        speeds = [config.get("speed_limit") or usual_speed]
    return float(max(speeds))


def success(env: gym.Env) -> bool | None:
    """Return whether the goal of a highway-env environment is reached now.

    It is None where there is no goal. A `GoalEnv` defines success; nothing succeeds
    after a crash.

    * exit: the car is on the exit or its lane.
    * intersection: every controlled car has arrived.
    * roundabout: the car has left the ring to the north.
    * merge: the car has passed the ramp.
    * u-turn: no goal, as the road back is 191 m away, more than its 10 s allow.
    """
    base: AbstractEnv = env.unwrapped
    if isinstance(base, GoalEnv):
        reached = base.success
    elif isinstance(base, ExitEnv):
        reached = base._is_success()
    elif isinstance(base, IntersectionEnv):
        reached = all(map(base.has_arrived, base.controlled_vehicles))
    elif isinstance(base, RoundaboutEnv):
        road = base.vehicle.lane_index[:2]
        reached = road in (("nx", "nxs"), ("nxs", "nxr"))
    elif isinstance(base, MergeEnv):
        end_of_v0 = 370.0  # m, where the episode ends
        reached = base.vehicle.position[0] > getattr(base, "end_position", end_of_v0)
    else:
        return None
    has_crashed = any(vehicle.crashed for vehicle in base.controlled_vehicles)
    return bool(reached) and not has_crashed


COPIED_ATTRIBUTES = (
    "color",
    "route",
    "target_speeds",
    "check_collisions",
    "collidable",
    "solid",
    "MIN_SPEED",
    "MAX_SPEED",
    "LENGTH",
    "WIDTH",
    "diagonal",
)
"""Instance attributes of a vehicle, beside its state, that its replacement keeps."""


def replace_ego(
    env: gym.Env,
    make: Callable[[Vehicle], Vehicle],
    number: int = 0,
) -> Vehicle:
    """Replace a controlled vehicle by another one.

    The new one is in the same state and on the same route.

    Args:
        env: a highway-env environment, or a wrapper of one, after a reset.
        make: returns the new vehicle, given the old one.
        number: of the controlled vehicle.

    Returns:
        The new vehicle.
    """
    base: AbstractEnv = env.unwrapped
    old = base.controlled_vehicles[number]
    new = make(old)
    new.position = old.position.copy()
    new.heading = old.heading
    new.speed = old.speed
    new.crashed = old.crashed
    new.impact = old.impact
    for name in vars(old).keys() & set(COPIED_ATTRIBUTES):
        setattr(new, name, getattr(old, name))
    if getattr(new, "color", None) is None:
        new.color = VehicleGraphics.EGO_COLOR
    new.on_state_update()
    base.controlled_vehicles[number] = new
    base.road.vehicles[base.road.vehicles.index(old)] = new

    # With one agent, the first controlled vehicle acts and observes anyway.
    if isinstance(base.action_type, MultiAgentAction):
        base.action_type.agents_action_types[number].controlled_vehicle = new
    if isinstance(base.observation_type, MultiAgentObservation):
        base.observation_type.agents_observation_types[number].observer_vehicle = new
    return new


OVERWRITTEN = {"DISTANCE_WANTED": 7, "COMFORT_ACC_MAX": 6, "COMFORT_ACC_MIN": -3}
"""Class attributes of `IDMVehicle` that a reset of an `IntersectionEnv` sets, for all
environments of the process.
"""


def restore_traffic() -> None:
    """Restore highway-env's values of the attributes in `OVERWRITTEN`.

    Nothing is restored if others than these have been set.
    """
    if OVERWRITTEN.items() <= vars(IDMVehicle).items():
        IDMVehicle.DISTANCE_WANTED = HIGHWAY_ENV_IDM.standstill
        IDMVehicle.COMFORT_ACC_MAX = HIGHWAY_ENV_IDM.max_acceleration
        IDMVehicle.COMFORT_ACC_MIN = -HIGHWAY_ENV_IDM.comfortable_braking
