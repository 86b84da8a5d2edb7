"""Drivers that are not this package's: highway-env's IDM and MOBIL, doing nothing, and chance."""

from time import perf_counter
from typing import Any

import gymnasium as gym
import numpy as np
from highway_env.envs.common.action import DiscreteMetaAction
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.benchmarks.road.goals import route_to_goal
from ms_highway.envs.road.ego import replace_ego
from ms_highway.envs.road.goals import desired_speed_of

__all__ = ["Idle", "Idm", "IdmEgo", "Peer", "Random"]


class Peer(gym.Wrapper):
    """Drive the ego of a stock environment; the action that `step` is given is ignored.

    ``info["road"]`` has the duration of the decisions of a step [s] in ``decisions``.

    Args:
        env: the environment.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.decisions: list[float] = []
        self.observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        self.observation, info = super().reset(seed=seed, options=options)
        self.begin(seed)
        return self.observation, info

    def step(self, action: Any = None) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Decide, and take a step of the environment."""
        self.decisions.clear()
        start = perf_counter()
        chosen = self.choose()
        self.decisions.append(perf_counter() - start)
        self.observation, reward, terminated, truncated, info = super().step(chosen)
        return self.observation, reward, terminated, truncated, info | {"road": self._told()}

    def begin(self, seed: int | None) -> None:
        """Prepare for an episode that has just been reset."""

    def choose(self) -> Any:
        """Return the action of the coming step."""
        raise NotImplementedError

    @property
    def inner(self) -> Any:
        """The environment without wrappers."""
        return self.unwrapped

    @property
    def target_speeds(self) -> np.ndarray:
        """Those of the environment's actions [m/s]."""
        return np.array(self.inner.config["action"].get("target_speeds", MDPVehicle.DEFAULT_TARGET_SPEEDS))

    def _told(self) -> dict[str, Any]:
        return {"decisions": list(self.decisions)}

    def _unheeded(self) -> Any:
        """Return an action for an ego that steers by itself, which rewards take for what it does."""
        action_type = self.inner.action_type
        if isinstance(action_type, DiscreteMetaAction):
            return action_type.actions_indexes["IDLE"]
        return np.interp([self.inner.vehicle.action["steering"]], action_type.steering_range, [-1.0, 1.0])


class Idle(Peer):
    """Keep speed and lane: the meta-action IDLE of highway-env's `MDPVehicle`, also where actions are continuous."""

    def begin(self, seed: int | None) -> None:
        """Put an `MDPVehicle` in the place of a vehicle that does not keep its lane by itself."""
        if not isinstance(self.inner.vehicle, MDPVehicle):
            speeds = self.target_speeds
            replace_ego(
                self.env,
                lambda old: MDPVehicle(old.road, old.position, old.heading, old.speed, target_speeds=speeds),
            )

    def choose(self) -> Any:
        """Return the action that changes nothing."""
        return self._unheeded()


class Random(Peer):
    """Choose among the environment's own actions by chance, the same ones for the same seed."""

    def begin(self, seed: int | None) -> None:
        """Seed the actions."""
        self.unwrapped.action_space.seed(seed)

    def choose(self) -> Any:
        """Draw an action."""
        return self.unwrapped.action_space.sample()


class IdmEgo(IDMVehicle):
    """highway-env's IDM and MOBIL in the place of the ego, with what rewards look for in an `MDPVehicle`.

    Attributes:
        target_speeds: of the environment's actions [m/s].
        decisions: where it notes the duration of each of its decisions [s].
    """

    target_speeds = MDPVehicle.DEFAULT_TARGET_SPEEDS
    decisions: list[float] | None = None

    @property
    def speed_index(self) -> int:
        """Number of the target speed that is closest to the own speed."""
        return int(MDPVehicle.speed_to_index(self, self.speed))

    def index_to_speed(self, index: int) -> float:
        """Return the target speed with a number [m/s]."""
        return float(self.target_speeds[index])

    def act(self, action: dict[str, Any] | str | None = None) -> None:
        """Follow and change lanes; the action is ignored."""
        start = perf_counter()
        super().act(action)
        if self.decisions is not None:
            self.decisions.append(perf_counter() - start)


class Idm(Peer):
    """Let highway-env's IDM and MOBIL drive the ego, as they drive the others: on a route to the goal, if there is one.

    They decide in every frame. The desired speed is that of `ms_highway.envs.road.goals.desired_speed_of`, as for this
    package's drivers; IDM keeps the speed limits of lanes by itself.
    """

    def begin(self, seed: int | None) -> None:
        """Put an `IdmEgo` in the place of the ego."""

        def make(old: Vehicle) -> Vehicle:
            ego = IdmEgo(old.road, old.position, old.heading, old.speed, target_speed=desired_speed_of(self.env))
            ego.target_speeds = self.target_speeds
            return ego

        ego = replace_ego(self.env, make)
        ego.route = route_to_goal(self.inner)
        ego.decisions = self.decisions

    def choose(self) -> Any:
        """Return an action that the ego ignores."""
        return self._unheeded()

    def _told(self) -> dict[str, Any]:
        return super()._told() | {"decisions": self.decisions[1:]}  # the first is that of `choose`
