"""Drive a stock environment from outside, as a policy of stable-baselines3 would: by continuous actions."""

from collections.abc import Mapping
from math import atan, sin, tan
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.envs.common.action import ContinuousAction, DiscreteAction
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.control.road import RoadStep
from ms_highway.envs.road.driven import check_drivable, normalised
from ms_highway.envs.road.settings import RoadSettings
from ms_highway.envs.road.stock import desired_speed_of, destination_of
from ms_highway.planning.road.settings import RoadWeights
from ms_highway.runtime.arrays import Control
from ms_highway.vehicle.appointment import destination_for, keep
from ms_highway.vehicle.road_robot import MARGIN, PERIOD, Velocity, keep_grip, steering_of
from ms_highway.vehicle.road_scene import observe_road

SLOWEST = 4.0  # Hz, of actions


class RoadPolicy:
    """Policy of environments that stay stock, with the interface of stable-baselines3's models.

    It reads the road from the environment, not from observations, and answers with ``[throttle, steering]``. It plans
    every 0.2 s, or in every step where these are longer, and holds its control in between. Where the vehicle is
    ``dynamical`` (``intersection-v1``), it slides as the planner does not expect.

    Args:
        env: with continuous actions, longitudinal and lateral, at 4 Hz or more: a highway-env environment, a wrapper
            of one, or a vector environment with a list ``envs`` of them.
        config: see `ms_highway.envs.road.settings.RoadSettings`.

    Attributes:
        steps: last step of the driver of each environment, None before the first.

    Raises:
        ValueError: for an environment of another kind, an unknown key or an impossible value.
    """

    def __init__(self, env: Any, config: Mapping[str, Any] | None = None) -> None:
        settings = RoadSettings.read(config)
        self.single = isinstance(env, gym.Env) and not isinstance(env, gym.vector.VectorEnv)
        envs: Any = [env] if self.single else getattr(env, "envs", None)
        if not isinstance(envs, (list, tuple)):
            message = "is neither an environment nor keeps a list of them"
            raise ValueError(f"{type(env).__name__} {message}; use gym.make(...), or SyncVectorEnv for several")
        self._pilots = [_Pilot(each, settings) for each in envs]

    @property
    def steps(self) -> list[RoadStep | None]:
        """Last step of the driver of each environment."""
        return [pilot.last_step for pilot in self._pilots]

    def predict(
        self, observation: Any = None, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the action of each environment now, and the state as it was given.

        Args:
            observation: not looked at, but for its shape: a batch of one is answered by a batch of one.
            state: not looked at.
            episode_start: which environments have just been reset; noticed anyway, by their new vehicles.
            deterministic: the policy is, either way.
        """
        starts = np.broadcast_to(False if episode_start is None else episode_start, len(self._pilots))
        actions = np.stack([pilot.act(bool(start)) for pilot, start in zip(self._pilots, starts, strict=True)])
        space = self._pilots[0].env.observation_space
        batch = isinstance(space, gym.spaces.Box) and np.shape(observation) == (1, *space.shape)
        return actions[0] if self.single and not batch else actions, state


class _Pilot:
    """Drives one environment."""

    def __init__(self, env: Any, settings: RoadSettings) -> None:
        check_drivable(env)
        _check_actions(env)
        self.env, self.settings = env, settings
        self.vehicle: Vehicle | None = None
        self.driver = settings.build(settings.planning(0.0))
        self.last_step: RoadStep | None = None
        self._planned_at = 0.0

    def act(self, start: bool) -> Control:
        """Return the action for the coming step."""
        base = self.env.unwrapped
        vehicle, frame = base.vehicle, 1 / base.config["simulation_frequency"]
        if start or vehicle is not self.vehicle:
            _check_actions(self.env)
            self.driver.planning, self.driver.weights = (
                self.settings.planning(desired_speed_of(self.env)),
                RoadWeights(),
            )
            self.driver.reset()
            self.vehicle, self.last_step = vehicle, None
        applied, before = _last_frame(vehicle, frame)
        if self.last_step is None or base.time - self._planned_at > PERIOD - 0.5 / base.config["policy_frequency"]:
            goal = destination_of(base)
            keep(goal, self.driver, vehicle, base.time)
            seen = observe_road(vehicle, destination_for(goal), applied, self.settings.intentions)
            self.last_step = self.driver.step(seen)
            self._planned_at = base.time
        now, grip = Velocity(vehicle.speed, vehicle.heading), MARGIN * self.settings.acceleration
        curvature, along = keep_grip(self.last_step.control, now, before, vehicle.LENGTH, frame, grip)
        action = {"acceleration": along, "steering": steering_of(curvature, vehicle.LENGTH)}
        return normalised(base.action_type, action)


def _last_frame(vehicle: Vehicle, frame: float) -> tuple[tuple[float, float], Velocity]:
    """Return curvature and acceleration of a vehicle in its last frame, and how its centre moved in it."""
    slip = atan(tan(float(vehicle.action["steering"])) / 2)
    curvature, acceleration = 2 * sin(slip) / vehicle.LENGTH, float(vehicle.action["acceleration"])
    speed = vehicle.speed - acceleration * frame
    return (curvature, acceleration), Velocity(speed, vehicle.heading - speed * curvature * frame + slip)


def _check_actions(env: Any) -> None:
    """Check that an environment can be driven by actions."""
    base, needs = env.unwrapped, None
    action_type, rate = base.action_type, base.config["policy_frequency"]
    if not isinstance(action_type, ContinuousAction) or isinstance(action_type, DiscreteAction):
        needs = f"continuous actions, not {type(action_type).__name__}"
    elif not (action_type.longitudinal and action_type.lateral):
        needs = "longitudinal and lateral actions"
    elif rate < SLOWEST:
        needs = f"{SLOWEST:g} actions per second or more, not {rate:g}"
    if needs:
        remedy = "config={'action': {'type': 'ContinuousAction'}, 'policy_frequency': 5}"
        raise ValueError(f"a RoadPolicy needs {needs}; make it with {remedy}, or use drive(env)")
