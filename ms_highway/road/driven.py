"""Let a robot drive the controlled vehicles of a stock environment of highway-env."""

from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from math import ceil
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium.core import RenderFrame
from gymnasium.utils import RecordConstructorArgs
from highway_env.envs import LaneKeepingEnv, MergeEnv, ParkingEnv, RoundaboutEnv
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.envs.common.action import (
    ActionType,
    ContinuousAction,
    DiscreteAction,
    DiscreteMetaAction,
    MultiAgentAction,
)
from highway_env.utils import lmap

from ms_highway.envs.configuration import as_json, checked_seed
from ms_highway.envs.game_env import GameEnv
from ms_highway.envs.viewer import enable_pictures
from ms_highway.perception.scene import SHAPE
from ms_highway.road.graphics import show
from ms_highway.road.robot import RoadRobot
from ms_highway.road.settings import RoadSettings
from ms_highway.road.stock import (
    desired_speed_of,
    destination_of,
    replace_ego,
    restore_traffic,
    success,
)
from ms_highway.road.traffic_models import TRAFFIC_MODELS

Info: TypeAlias = dict[str, Any]
"""What ``reset`` and ``step`` tell besides the observation, by key."""

Observation: TypeAlias = Any
Reward: TypeAlias = Any
"""The environment's own; with several agents, tuples of them."""

Action: TypeAlias = np.ndarray | int | tuple["Action", ...]
"""An action of highway-env; with several agents, a tuple of them."""


def drive(env: gym.Env, config: Mapping[str, object] | None = None) -> "Driven":
    """Let a robot drive the controlled vehicles of a stock environment of highway-env.

    The environment keeps its spaces, reward and time limits. Actions are ignored, and
    ``info["road"]`` says what the robot does, see `Driven`::

        stock = gym.make("roundabout-v0", render_mode="rgb_array")
        env = ms_highway.drive(stock, {"desired_speed": 12.0})
        env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(None)

    Args:
        env: a highway, merge, roundabout, intersection, exit, two-way, u-turn or
            racetrack environment. highway-env itself cannot make merge and roundabout
            with ``ContinuousAction``.
        config: any of these keys, see `ms_highway.road.settings.RoadSettings`:
            ``driver`` (``"priced"`` by default; ``"fixed:naive"``, ...; or a name of
            `ms_highway.add_driver`, see `ms_highway.road.added.AddedRoadDriver`),
            ``price`` [reward/s] or ``budget`` [ms] of computation, ``desired_speed``
            [m/s], ``acceleration`` [m/s^2], ``curvature`` [1/m], ``ladder``, ``costs``
            and ``intentions`` (whether the robot knows the routes of others).

    Returns:
        The environment, driven.

    Raises:
        ValueError: for an environment without roads to follow, an unknown key or an
            impossible value.
    """
    return Driven(env, config)


def check_drivable(env: gym.Env) -> None:
    """Check that a robot can drive an environment.

    It has to be one of highway-env's, have roads to follow, and have actions that its
    reward accepts.

    Raises:
        ValueError: naming what works.
    """
    base: AbstractEnv = env.unwrapped
    name = base.spec.id if base.spec else type(base).__name__
    reason = None
    if isinstance(base, ParkingEnv):
        reason = "has no road to follow"
    elif isinstance(base, LaneKeepingEnv):
        reason = "observes the inner state of its own vehicle"
    elif not isinstance(base, AbstractEnv) or isinstance(base, GameEnv):
        reason = "is none of highway-env's own environments"
    if reason:
        raise ValueError(
            f"{name} {reason}; the robot drives highway, merge, roundabout,"
            " intersection, exit, two-way, u-turn and racetrack environments"
        )

    # Rewards of merge and roundabout look up a single action in a table.
    action_type = base.action_type
    is_continuous = type(action_type) is ContinuousAction and action_type.size > 1
    if isinstance(base, (MergeEnv, RoundaboutEnv)) and is_continuous:
        raise ValueError(
            f"the reward of {name} reads lane changes, which a ContinuousAction does"
            " not have; make the environment with config={'action': {'type':"
            " 'DiscreteMetaAction'}}"
        )


class Driven(gym.Wrapper, RecordConstructorArgs):
    """Lets a robot drive the controlled vehicles of a stock environment.

    The environment keeps its spaces, reward and time limits.

    Actions are ignored: the robot plans every 0.2 s, whatever the environment's policy
    frequency is, and holds its control in between. ``info["road"]["action"]`` is the
    ``ContinuousAction`` that repeats what the robots did in this step, for imitation
    learning, see `executed_action`. It is None with discrete or ``dynamical`` actions,
    and in steps longer than 0.2 s, within which the control changes. ``info["action"]``
    is only the action that highway-env's rewards receive: idle, or the control of the
    last step. ``info["is_success"]`` is ``info["road"]["success"]``, where the scene
    has a goal. Every key is there from the reset on, with one shape and type.
    ``info["road"]`` describes the first controlled vehicle:

    * ``models``, ``source``, ``broken``, ``failed``, ``planning_seconds``,
      ``decision_seconds``, ``compile_seconds`` of the last plan, see
      `ms_highway.road.driver.RoadStep`; ``gains``, by model: an upper bound on what
      predicting each car by this model may gain, NaN where none was estimated;
    * ``decisions``, ``sources``: duration of every plan within this step [s], without
      compilation, and what drove then; NaN and an empty text for each plan that was not
      made;
    * ``late``: number of these plans that were not ready within the budget, so that the
      last plan drove on;
    * ``model_counts``: how many cars each model predicted, summed over these plans;
    * ``acceleration``, ``jerk``: the largest in any frame of this step [m/s^2, m/s^3];
    * ``destination``: node of the road network, or spot on a lane, None without one;
    * ``success``: whether the goal is reached now, None without one.

    Attributes:
        settings: of the robot.
        robots: drive the controlled vehicles of this episode.
    """

    def __init__(
        self,
        env: gym.Env,
        config: Mapping[str, object] | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(self, config=as_json(config))
        gym.Wrapper.__init__(self, env)
        check_drivable(env)
        self.settings = RoadSettings.read(config)
        self.robots: list[RoadRobot] = []
        show(env)

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, Info]:
        """Start an episode, and replace every controlled vehicle by a robot.

        Raises:
            ValueError: for an impossible seed, or if options give the environment
                actions that its reward does not accept.
        """
        seed = checked_seed(seed)
        restore_traffic()
        show(self.env)
        try:
            observation, info = self.env.reset(seed=seed, options=options)
        except ValueError:
            check_drivable(self.env)
            raise
        base: AbstractEnv = self.unwrapped
        is_own_observation = self.env.observation_space == base.observation_space
        if enable_pictures(base) and is_own_observation:
            observation = base.observation_type.observe()  # the first picture was black

        # Traffic must not depend on who drives, so the robots draw from a copy.
        random = deepcopy(base.np_random)
        frame = 1 / base.config["simulation_frequency"]
        planning = self.settings.planning(desired_speed_of(base), frame)
        self.robots = []
        for number in range(len(base.controlled_vehicles)):
            goal = destination_of(base, number)
            robot = replace_ego(base, RoadRobot.create_from, number)
            robot.drive_with(
                self.settings.build(planning, random),
                goal,
                self.settings.acceleration,
                self.settings.intentions,
            )
            self.robots.append(robot)
        return observation, self._described(info)

    def step(self, action: object) -> tuple[Observation, Reward, bool, bool, Info]:
        """Let the robot drive for a step; the action is ignored.

        Raises:
            ResetNeeded: if this wrapper has not been reset, or the environment below it
                has been since.
        """
        base: AbstractEnv = self.unwrapped
        if not self.robots or base.controlled_vehicles != self.robots:
            raise gym.error.ResetNeeded(
                "the robot is not in the car; call reset of the driven environment, not"
                " of an inner one"
            )
        for robot in self.robots:
            robot.forget()
        *outcome, info = self.env.step(placeholder_action(base.action_type))
        return *outcome, self._described(info)

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        """Show the road, the plan, the predictions and the rungs."""
        show(self.env)
        return self.env.render()

    def _described(self, info: Info) -> Info:
        """Return ``info`` with the driver's part.

        Its shapes and types are the same before and after the first step. highway-env
        returns some speeds as whole numbers after a reset; they become decimal numbers.
        """
        robot = self.robots[0]
        reached = success(self)
        road = {
            **self._last_step(robot),
            **self._plans(robot),
            "acceleration": float(max(robot.accelerations, default=0.0)),
            "jerk": float(max(robot.jerks, default=0.0)),
            "destination": robot.goal_place,
            "success": reached,
            "action": self._action(),
        }
        described = {**info, "road": road}
        if "speed" in info:
            described["speed"] = float(info["speed"])
        if reached is not None:
            described["is_success"] = reached
        return described

    def _last_step(self, robot: RoadRobot) -> Info:
        """Return what ``info["road"]`` says of the driver's last step.

        Before the first step, it has values of the same types.
        """
        last = robot.last_step
        gains = np.full((SHAPE.paths, len(TRAFFIC_MODELS)), np.nan)
        if last is not None and last.gains is not None:
            gains = np.asarray(last.gains)
        return {
            "models": ("",) * SHAPE.paths if last is None else last.models,
            "source": "" if last is None else last.source,
            "broken": False if last is None else last.broken,
            "failed": False if last is None else last.failed,
            "planning_seconds": 0.0 if last is None else last.planning_seconds,
            "decision_seconds": 0.0 if last is None else last.decision_seconds,
            "compile_seconds": 0.0 if last is None else last.compile_seconds,
            "gains": dict(zip(TRAFFIC_MODELS, gains.T, strict=True)),
        }

    def _plans(self, robot: RoadRobot) -> Info:
        """Return what ``info["road"]`` says of the plans of this step.

        Plans that were not made leave their places empty.
        """
        seconds = [
            step.planning_seconds + step.decision_seconds for step in robot.steps
        ]
        sources = [step.source for step in robot.steps]
        missing = ceil(self._frames / self._frames_of_plan) - len(seconds)
        counts = Counter(name for step in robot.steps for name in step.models)
        return {
            "decisions": np.array(seconds + [np.nan] * missing),
            "sources": (*sources, *[""] * missing),
            "late": sum(step.status == "late" for step in robot.steps),
            "model_counts": {name: counts[name] for name in TRAFFIC_MODELS},
        }

    def _action(self) -> np.ndarray | tuple[np.ndarray | None, ...] | None:
        """Return the action that repeats what the robots did in this step.

        It is None where there is no such action; with several robots, there is one for
        each.
        """
        if self._frames > self._frames_of_plan:
            return None
        base: AbstractEnv = self.unwrapped
        if not isinstance(base.action_type, MultiAgentAction):
            return executed_action(base.action_type, self.robots[0])
        types = base.action_type.agents_action_types
        actions = tuple(map(executed_action, types, self.robots))
        return None if any(action is None for action in actions) else actions

    @property
    def _frames(self) -> int:
        """Frames of the simulation in a step."""
        config = self.unwrapped.config  # type: ignore[attr-defined]
        return config["simulation_frequency"] // config["policy_frequency"]

    @property
    def _frames_of_plan(self) -> int:
        """Frames of the simulation for which a plan drives."""
        config = self.unwrapped.config  # type: ignore[attr-defined]
        return max(1, round(RoadRobot.period * config["simulation_frequency"]))


def placeholder_action(action_type: ActionType) -> Action:
    """Return the action that rewards receive for a car that drives itself.

    It is idle, or what the car last executed.
    """
    if isinstance(action_type, MultiAgentAction):
        return tuple(map(placeholder_action, action_type.agents_action_types))
    if isinstance(action_type, DiscreteMetaAction):
        return action_type.actions_indexes["IDLE"]
    action = _nearest_in(action_type, action_type.controlled_vehicle.action)
    if not isinstance(action_type, DiscreteAction):
        return action

    # The number of the nearest point on the grid of a discrete space.
    points = action_type.actions_per_axis
    places = np.rint((action + 1) / 2 * (points - 1)).astype(int)
    return int(np.ravel_multi_index(tuple(places), (points,) * action_type.size))


def executed_action(action_type: ActionType, robot: RoadRobot) -> np.ndarray | None:
    """Return the ``ContinuousAction`` that repeats a robot's step.

    It is None for other types of actions. It is NaN where no action of the space does
    the same, because tyres or highway-env's limits changed the control within the step,
    or because the control is outside the ranges of the space.
    """
    is_continuous = isinstance(action_type, ContinuousAction)
    if not is_continuous or isinstance(action_type, DiscreteAction):
        return None
    if action_type.dynamical:
        return None
    frames = robot.actions
    if not frames:  # at the reset, nothing has been done yet
        return np.full(action_type.space().shape, np.nan, np.float32)

    # The control in every frame, against that of the action.
    tolerance = 1e-5  # m/s^2 and rad
    action = _nearest_in(action_type, frames[0])
    repeated = ContinuousAction.get_action(action_type, action)
    is_same = all(
        abs(frame[key] - value) < tolerance
        for frame in frames
        for key, value in repeated.items()
    )
    return action if is_same else np.full_like(action, np.nan)


def _nearest_in(
    action_type: ContinuousAction,
    executed: Mapping[str, float],
) -> np.ndarray:
    """Return the continuous action that is nearest to what a vehicle executed.

    Args:
        action_type: of the space.
        executed: acceleration [m/s^2] and steering [rad].

    Returns:
        An array; acceleration comes first.
    """
    values = []
    if action_type.longitudinal:
        acceleration = executed["acceleration"]
        values.append(lmap(acceleration, action_type.acceleration_range, (-1, 1)))
    if action_type.lateral:
        steering = executed["steering"]
        values.append(lmap(steering, action_type.steering_range, (-1, 1)))
    return np.clip(values, -1, 1).astype(np.float32)
