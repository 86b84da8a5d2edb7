"""Let a robot drive the controlled vehicles of a stock environment of highway-env."""

from collections import Counter
from collections.abc import Mapping
from copy import deepcopy
from math import ceil
from typing import Any

import gymnasium as gym
import numpy as np
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
from ms_highway.perception.scene import TRAFFIC
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

WORKS = (
    "highway, merge, roundabout, intersection, exit, two-way, u-turn and racetrack"
    " environments"
)
UNTIL_FIRST = {
    "models": ("",) * TRAFFIC,
    "source": "",
    "broken": False,
    "failed": False,
    "planning_seconds": 0.0,
    "decision_seconds": 0.0,
    "compile_seconds": 0.0,
}
"""Fields of the driver's last step in ``info["road"]``, with their values before the
first step.
"""

NO_GAINS = np.full((TRAFFIC, len(TRAFFIC_MODELS)), np.nan)
# m/s^2 and rad: the control in the frames of a step may differ from its action by this
# much
SAME = 1e-5


def drive(env: Any, config: Mapping[str, Any] | None = None) -> "Driven":
    """Let a robot drive the controlled vehicles of a stock environment of highway-env.

    The environment keeps its spaces, reward and time limits. Actions are ignored, and
    ``info["road"]`` says what the robot does, see `Driven`::

        env = ms_highway.drive(gym.make("roundabout-v0", render_mode="rgb_array"), {"desired_speed": 12.0})
        env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(None)

    Args:
        env: a highway, merge, roundabout, intersection, exit, two-way, u-turn or racetrack environment. highway-env
            itself cannot make merge and roundabout with ``ContinuousAction``.
        config: any of these keys, see `ms_highway.road.settings.RoadSettings`: ``driver`` (``"priced"`` by
            default; ``"fixed:naive"``, ...; or a name of `ms_highway.add_driver`, see
            `ms_highway.road.added.AddedRoadDriver`), ``price`` [reward/s] or ``budget`` [ms] of computation,
            ``desired_speed`` [m/s], ``acceleration`` [m/s^2], ``curvature`` [1/m], ``ladder``, ``costs`` and
            ``intentions`` (whether the robot knows the routes of others).

    Returns:
        The environment, driven.

    Raises:
        ValueError: for an environment without roads to follow, an unknown key or an impossible value.
    """
    return Driven(env, config)


def check_drivable(env: Any) -> None:
    """Check that an environment is one of highway-env's, has roads to follow, and has
    actions that its reward accepts.

    Raises:
        ValueError: naming what works.
    """
    base = env.unwrapped
    reason = None
    name = base.spec.id if base.spec else type(base).__name__
    if isinstance(base, ParkingEnv):
        reason = "has no road to follow"
    elif isinstance(base, LaneKeepingEnv):
        reason = "observes the inner state of its own vehicle"
    elif not isinstance(base, AbstractEnv) or isinstance(base, GameEnv):
        reason = "is none of highway-env's own environments"
    if reason:
        raise ValueError(f"{name} {reason}; the robot drives {WORKS}")
    kind = base.action_type
    if (
        isinstance(base, (MergeEnv, RoundaboutEnv))
        and type(kind) is ContinuousAction
        and kind.size > 1
    ):
        remedy = (
            "make the environment with config={'action': {'type':"
            " 'DiscreteMetaAction'}}"
        )
        raise ValueError(
            f"the reward of {name} reads lane changes, which a ContinuousAction does"
            f" not have; {remedy}"
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

    def __init__(self, env: Any, config: Mapping[str, Any] | None = None) -> None:
        RecordConstructorArgs.__init__(self, config=as_json(config))
        gym.Wrapper.__init__(self, env)
        check_drivable(env)
        self.settings = RoadSettings.read(config)
        self.robots: list[RoadRobot] = []
        show(env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
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
        base: Any = self.unwrapped
        if (
            enable_pictures(base)
            and self.env.observation_space == base.observation_space
        ):
            observation = base.observation_type.observe()  # the first picture was black
        frame = 1 / base.config["simulation_frequency"]
        planning = self.settings.planning(desired_speed_of(base), frame)
        random = deepcopy(
            base.np_random
        )  # so that traffic does not depend on who drives
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

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Let the robot drive for a step; the action is ignored.

        Raises:
            ResetNeeded: if this wrapper has not been reset, or the environment below it
                has been since.
        """
        base: Any = self.unwrapped
        if not self.robots or base.controlled_vehicles != self.robots:
            raise gym.error.ResetNeeded(
                "the robot is not in the car; call reset of the driven environment, not"
                " of an inner one"
            )
        for robot in self.robots:
            robot.forget()
        *outcome, info = self.env.step(placeholder_action(base.action_type))
        return *outcome, self._described(info)

    def render(self) -> Any:
        """Show the road, the plan, the predictions and the rungs."""
        show(self.env)
        return self.env.render()

    def _described(self, info: dict[str, Any]) -> dict[str, Any]:
        """Return ``info`` with the driver's part, whose shapes and types are the same
        before and after the first step.

        highway-env returns some speeds as whole numbers after a reset; they become
        decimal numbers.
        """
        robot = self.robots[0]
        base: Any = self.unwrapped
        kind = base.action_type
        reached = success(base)

        # Plans of this step; those that were not made leave their places empty.
        frequency = base.config["simulation_frequency"]
        frames = frequency // base.config["policy_frequency"]
        frames_of_plan = max(1, round(RoadRobot.period * frequency))
        seconds = [
            step.planning_seconds + step.decision_seconds for step in robot.steps
        ]
        missing = ceil(frames / frames_of_plan) - len(seconds)
        counts = Counter(name for step in robot.steps for name in step.models)
        last = robot.last_step
        gains = NO_GAINS if last is None or last.gains is None else last.gains

        # The action that does the same, if there is one; with several robots, one for
        # each.
        kinds = (
            kind.agents_action_types if isinstance(kind, MultiAgentAction) else [kind]
        )
        executed: Any = tuple(map(executed_action, kinds, self.robots))
        if frames > frames_of_plan or any(each is None for each in executed):
            executed = None
        elif not isinstance(kind, MultiAgentAction):
            executed = executed[0]

        road = {
            name: getattr(last, name, value) for name, value in UNTIL_FIRST.items()
        } | {
            "gains": dict(zip(TRAFFIC_MODELS, gains.T, strict=True)),
            "decisions": np.array(seconds + [np.nan] * missing),
            "sources": (*(step.source for step in robot.steps), *[""] * missing),
            "late": sum(step.status == "late" for step in robot.steps),
            "model_counts": {name: counts[name] for name in TRAFFIC_MODELS},
            "acceleration": float(max(robot.accelerations, default=0.0)),
            "jerk": float(max(robot.jerks, default=0.0)),
            "destination": robot.goal_place,
            "success": reached,
            "action": executed,
        }
        described = {**info, "road": road}
        if "speed" in info:
            described["speed"] = float(info["speed"])
        if reached is not None:
            described["is_success"] = reached
        return described


def placeholder_action(action_type: ActionType) -> Any:
    """Return the action that rewards receive for a car that drives itself: idle, or
    what it last executed.
    """
    if isinstance(action_type, MultiAgentAction):
        return tuple(map(placeholder_action, action_type.agents_action_types))
    if isinstance(action_type, DiscreteMetaAction):
        return action_type.actions_indexes["IDLE"]
    return _nearest_in(action_type, action_type.controlled_vehicle.action)


def executed_action(action_type: ActionType, robot: RoadRobot) -> np.ndarray | None:
    """Return the ``ContinuousAction`` that repeats a robot's step; None for other types
    of actions.

    It is NaN where no action of the space does the same, because tyres or highway-env's
    limits changed the control within the step, or because the control is outside the
    ranges of the space.
    """
    continuous = isinstance(action_type, ContinuousAction) and not isinstance(
        action_type, DiscreteAction
    )
    if not continuous or action_type.dynamical:
        return None
    if not robot.actions:  # at the reset, nothing has been done yet
        return np.full(action_type.space().shape, np.nan, np.float32)
    frames = robot.actions
    action = _nearest_in(action_type, frames[0])
    repeated = ContinuousAction.get_action(action_type, action)
    same = all(
        abs(frame[key] - repeated[key]) < SAME for frame in frames for key in repeated
    )
    return action if same else np.full_like(action, np.nan)


def _nearest_in(action_type: ContinuousAction, executed: Mapping[str, float]) -> Any:
    """Return the action of a space that is nearest to what a vehicle executed [m/s^2,
    rad]; acceleration first.
    """
    values = []
    if action_type.longitudinal:
        values.append(
            lmap(executed["acceleration"], action_type.acceleration_range, (-1, 1))
        )
    if action_type.lateral:
        values.append(lmap(executed["steering"], action_type.steering_range, (-1, 1)))
    action = np.clip(values, -1, 1).astype(np.float32)
    if isinstance(action_type, DiscreteAction):
        places = np.rint((action + 1) / 2 * (action_type.actions_per_axis - 1)).astype(
            int
        )
        return int(
            np.ravel_multi_index(
                tuple(places), (action_type.actions_per_axis,) * action_type.size
            )
        )
    return action
