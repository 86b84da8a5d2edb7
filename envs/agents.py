"""Let agents and planners of one's own drive instead of a controller.

So both can be compared.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from os import PathLike, fspath
from pathlib import Path
from pickle import UnpicklingError
from time import perf_counter
from typing import (
    Any,
    NamedTuple,
    Protocol,
    SupportsFloat,
    TypeAlias,
    cast,
)

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ms_highway.envs.configuration import Config
from ms_highway.envs.info import plan_info
from ms_highway.runtime.names import keep_apart
from ms_highway.runtime.sources import digest

Observation: TypeAlias = Any
"""What an environment shows, of any type of Gymnasium's spaces."""

Action: TypeAlias = Any
"""What an environment takes, of any type of Gymnasium's spaces."""

Policy: TypeAlias = Callable[[Observation], Action]
"""A function from an observation to an action."""


class Predictor(Protocol):
    """An agent of stable-baselines3, or an object with the same method."""

    def predict(
        self,
        observation: Observation,
        *,
        deterministic: bool,
    ) -> tuple[np.ndarray, object]:
        """Return the action for an observation, and a state that is ignored."""


Agent: TypeAlias = Policy | Predictor


class AddedAgent(NamedTuple):
    """An agent that has been added.

    Attributes:
        source: the agent, or the path of a file that stable-baselines3 has saved.
        config: action and observation of environments that it drives in.
    """

    source: Agent | str | PathLike[str]
    config: Config


AGENTS: dict[str, AddedAgent] = {}
"""The agents that `ms_highway.add_agent` has added, by name."""

keep_apart("an agent", lambda: AGENTS)


def is_agent(name: str) -> bool:
    """Return whether a name is an agent's.

    That is a name of an added agent, or of a file that stable-baselines3 saves.
    """
    return name in AGENTS or name.endswith(".zip")


def agent_config(name: str) -> Config:
    """Return the configuration of environments that an agent drives in.

    See `ms_highway.add_agent`.
    """
    config = AGENTS[name].config if name in AGENTS else {}
    space = getattr(_agent(name), "action_space", None)
    chooses = isinstance(space, (spaces.Discrete, spaces.MultiDiscrete))
    action: Config = {"type": "ContinuousAction"}
    if chooses:
        action = {"type": "HumanModelAction", "lambda": 0.0}
    return {"action": action, **config}


def policy_of(name: str) -> Policy:
    """Return the function that chooses the actions of an agent.

    Raises:
        ModuleNotFoundError: for a file, without stable-baselines3 or another package
            that it needs.
        ValueError: if the file is no agent.
    """
    agent = _agent(name)
    # Not by isinstance, which from Python 3.12 on misses what `__getattr__` gives.
    of_agent = getattr(agent, "predict", None)
    if of_agent is None:
        return cast(Policy, agent)

    def predict(observation: Observation) -> Action:
        action, _ = of_agent(observation, deterministic=True)
        return action if action.shape else action.item()

    return predict


def agent_file(name: str) -> str | None:
    """Return the path of the file that holds an agent; None without a file."""
    source = AGENTS[name].source if name in AGENTS else name
    return fspath(source) if isinstance(source, (str, PathLike)) else None


def _agent(name: str) -> Agent:
    """Return the agent that was added by this name, or that this file holds."""
    source = AGENTS[name].source if name in AGENTS else name
    if isinstance(source, (str, PathLike)):
        return saved_policy(fspath(source))
    return source


def saved_policy(file: str) -> Predictor:
    """Return the policy of an agent that stable-baselines3 has saved.

    Opening the file may run any code in it.

    Raises:
        ModuleNotFoundError: without stable-baselines3, or another package that the
            agent needs.
        ValueError: if the file is no such agent.
    """
    if not Path(file).is_file():
        raise ValueError(
            f"there is no agent {file}; notebooks/examples/train_peers.py trains some"
        )
    return _saved_policy(file, digest(Path(file)))


@cache
def _saved_policy(file: str, content: str) -> Predictor:
    """Read a file once for every content, whose digest is given; see `saved_policy`."""
    try:
        from stable_baselines3.common.save_util import load_from_zip_file

        data, parameters, _ = load_from_zip_file(file, device="cpu")
        options = {"use_sde": True} if data.get("use_sde") else {}
        policy = data["policy_class"](
            data["observation_space"],
            data["action_space"],
            lambda _: 0.0,  # the learning rate, which nothing uses
            **options,
            **data["policy_kwargs"],
        )
        policy.load_state_dict(parameters["policy"])
    except ModuleNotFoundError as error:
        package = str(error.name).replace("_", "-")
        message = f"the agent {file} needs the package {package}: pip install {package}"
        raise ModuleNotFoundError(message, name=error.name) from None
    except (
        ValueError,
        KeyError,
        TypeError,
        OSError,
        RuntimeError,
        UnpicklingError,
    ) as error:
        raise ValueError(
            f"{file} is no agent that stable-baselines3 has saved ({error!r})"
        ) from None
    return policy


def check_spaces(name: str, env: gym.Env) -> None:
    """Check that an environment has the spaces that an agent was trained for.

    Agents that name no spaces pass.

    Raises:
        ValueError: naming the space that differs.
    """
    agent = _agent(name)
    for space in ("observation_space", "action_space"):
        known = getattr(agent, space, None)
        offered = getattr(env, space)
        if known is not None and known != offered:
            scene = env.spec.id if env.spec else "the environment"
            what = space.replace("_", " ")
            raise ValueError(
                f"{name}: the agent's {what} is {known}, that of {scene} {offered};"
                " train one there"
            )


class AgentDrives(gym.Wrapper):
    """An environment in which an agent drives as a controller does.

    The only action is 0. ``info`` has the same keys as under a controller: ``model``,
    the agent's name or the model that it chooses; ``timing``, whose decision time
    includes the agent's; and ``gains``, which are empty.

    Args:
        env: the environment.
        name: of the agent.

    Raises:
        ValueError: if the agent was trained for other spaces.
    """

    def __init__(self, env: gym.Env, name: str) -> None:
        super().__init__(env)
        check_spaces(name, env)
        self.name = name
        self.policy = policy_of(name)
        self.action_space = spaces.Discrete(1)

    def reset(self, **options: Any) -> tuple[Observation, Config]:
        """Start an episode."""
        self._observation, info = self.env.reset(**options)
        return self._observation, self._described(info, "", "", 0.0)

    def step(
        self,
        action: object,
    ) -> tuple[Observation, SupportsFloat, bool, bool, Config]:
        """Let the agent choose an action, and take it.

        Raises:
            ValueError: if the environment's action space does not contain the agent's
                action.
        """
        observation = deepcopy(self._observation)  # which others hold, too
        start = perf_counter()
        chosen = self.policy(observation)
        seconds = perf_counter() - start

        # Agents may return lists or double precision.
        if isinstance(self.env.action_space, spaces.Box):
            chosen = np.asarray(chosen, self.env.action_space.dtype)
        if not self.env.action_space.contains(chosen):
            raise ValueError(
                f"the agent {self.name!r} chose {chosen!r}; the actions are"
                f" {self.env.action_space}"
            )
        self._observation, reward, terminated, truncated, info = self.env.step(chosen)
        described = self._described(info, self.name, "planned", seconds)
        return self._observation, reward, terminated, truncated, described

    def _described(
        self,
        info: Config,
        model: str,
        status: str,
        seconds: float,
    ) -> Config:
        """Return ``info`` with all keys that it has under a controller.

        The agent's seconds are added to the times.
        """
        usual = plan_info(None, 1)
        timing = info.get("timing", usual["timing"])
        timing = replace(timing, decision_seconds=timing.decision_seconds + seconds)
        chosen = {"model": model, "models": (model,), "gains": {}, "status": status}
        return {**usual, **chosen, **info, "timing": timing}
