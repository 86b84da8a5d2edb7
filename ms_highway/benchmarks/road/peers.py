"""Drivers that are not this package's: highway-env's IDM and MOBIL, trained agents, and the humans of recordings."""

from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.envs import ExitEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

from ms_highway.envs.agents import check_spaces, policy_of
from ms_highway.game.scenario import TIME_STEP
from ms_highway.recorded.environment import RecordedEnv
from ms_highway.recorded.traffic import GuidedVehicle
from ms_highway.road.driven import placeholder_action
from ms_highway.road.stock import desired_speed_of, destination_of, replace_ego
from ms_highway.road.timed_goal import TimedGoal
from ms_highway.vehicle.bicycle import OfferedSpeeds


class Peer(gym.Wrapper):
    """Drive the ego of a stock environment; the action that `step` is given is ignored.

    ``info["road"]`` has the duration of the decisions of a step [s] in ``decisions``.

    Args:
        env: the environment.

    Attributes:
        inner: the environment without its wrappers.
        seen: the last observation.
        decisions: duration of those of the present step that the ego takes by itself, frame by frame [s].
    """

    seen: Any

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.inner: Any = env.unwrapped
        self.decisions: list[float] = []

    def reset(self, **options: Any) -> tuple[Any, dict]:
        """Start an episode."""
        self.seen, info = super().reset(**options)
        self.begin()
        return self.seen, info

    def step(self, action: Any = None) -> tuple[Any, Any, bool, bool, dict]:
        """Decide, and take a step of the environment."""
        self.decisions.clear()
        start = perf_counter()
        chosen = self.choose()
        seconds = perf_counter() - start
        self.seen, *outcome, info = super().step(chosen)
        return self.seen, *outcome, info | {"road": {"decisions": [*self.decisions] or [seconds]}}

    def begin(self) -> None:
        """Prepare for an episode that has just been reset."""

    def choose(self) -> Any:
        """Return the action of the coming step: by default, one for an ego that steers by itself."""
        return placeholder_action(self.inner.action_type)


class Agent(Peer):
    """Take the actions of an agent, see `ms_highway.envs.agents`.

    Args:
        env: the environment.
        name: of the agent, or its file.

    Raises:
        ModuleNotFoundError: for a file, without stable-baselines3.
        ValueError: if the file is no agent, or the agent knows other observations or actions.
    """

    def __init__(self, env: gym.Env, name: str) -> None:
        super().__init__(env)
        check_spaces(name, env)
        self.policy = policy_of(name)

    def choose(self) -> Any:
        """Return the agent's action after the last observation."""
        return self.policy(self.seen)


class IdmEgo(OfferedSpeeds, IDMVehicle):
    """highway-env's IDM and MOBIL in the place of the ego, with what rewards look for in an `MDPVehicle`.

    Attributes:
        decisions: list to which it appends the duration of each of its decisions [s].
    """

    decisions: list[float]

    def act(self, action: dict | str | None = None) -> None:
        """Follow and change lanes; the action is ignored."""
        start = perf_counter()
        super().act(action)
        if action is None:  # once a frame, and not when the environment hands its action on
            self.decisions.append(perf_counter() - start)


class Idm(Peer):
    """Let highway-env's IDM and MOBIL drive the ego, as they drive the others: on a route to the goal, if there is one.

    They decide in every frame. The desired speed is that of `ms_highway.road.stock.desired_speed_of`, as for this
    package's drivers; IDM keeps the speed limits of lanes by itself. A timed goal sets the desired speed instead.
    """

    def begin(self) -> None:
        """Put an `IdmEgo` in the place of the ego."""
        speed = desired_speed_of(self.env)
        ego: Any = replace_ego(
            self.env, lambda old: IdmEgo(old.road, old.position, old.heading, old.speed, target_speed=speed)
        )
        ego.target_speeds = np.array(self.inner.config["action"].get("target_speeds", MDPVehicle.DEFAULT_TARGET_SPEEDS))
        ego.decisions, goal = self.decisions, destination_of(self.inner)
        if isinstance(self.inner, ExitEnv):
            last = self.inner.config["lanes_count"]
            ego.route = [("0", "1", last - 1), ("1", "2", last), ("2", "exit", 0)]
        elif isinstance(goal, str):
            ego.plan_route_to(goal)
            ego.route[0] = (*ego.lane_index[:2], None)  # any lane will do

    def choose(self) -> Any:
        """Let the ego decide, at the speed that reaches a timed goal in time."""
        goal = destination_of(self.inner)
        if isinstance(goal, TimedGoal):
            self.inner.vehicle.target_speed = goal.desired_speed(self.inner.vehicle, self.inner.time)
        return super().choose()


class Human(Peer):
    """Drive as the recorded vehicle that the ego replaces, and then straight on.

    Raises:
        ValueError: from a reset, for a planning problem, where the ego replaces no vehicle.
    """

    def begin(self) -> None:
        """Put a vehicle that moves to given states in the place of the ego."""
        env = self.inner
        if not isinstance(env, RecordedEnv) or env.task.track is None:
            raise ValueError("the driver human goes as a recorded vehicle did; say --egos changing")
        self._track: Any = env.scenario.track(env.task.track)
        replace_ego(env, lambda old: GuidedVehicle(old.road, old.position, old.heading, old.speed))

    def choose(self) -> Any:
        """Give the ego the recorded state at the end of the step."""
        road, last = self.inner.road, int(self._track.samples[-1, 0])
        position, heading, speed = road.recorded_state(self._track, road.now + 1)
        beyond = TIME_STEP * max(road.now + 1 - last, 0) * speed
        self.inner.vehicle.coming = position + beyond * np.array([np.cos(heading), np.sin(heading)]), heading, speed
        return super().choose()
