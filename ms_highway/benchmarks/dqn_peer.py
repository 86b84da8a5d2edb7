"""DQN of stable-baselines3, which learns which human model is worth its time: a peer of controllers that decide.

The agent acts in environments with `ms_highway.envs.actions.HumanModelAction`: its action is the human model of the
coming step, its reward that of the meta-MDP, ``r_R - lambda T(M)``, and it sees
`ms_highway.envs.observations.CarStates`, which are scaled to about [-1, 1].
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, cast

import gymnasium as gym
import numpy as np

from ms_highway.envs import environment_id
from ms_highway.envs.base import InteractionEnv

__all__ = ["SETTINGS", "OwnStarts", "Trained", "Training", "steps_per_second", "trained"]

SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "highway-env": {
        "policy_kwargs": {"net_arch": [256, 256]},
        "learning_rate": 5e-4,
        "buffer_size": 15_000,
        "learning_starts": 200,
        "batch_size": 32,
        "gamma": 0.8,
        "train_freq": 1,
        "gradient_steps": 1,
        "target_update_interval": 50,
    },
}
"""Hyperparameters by name: the defaults of stable-baselines3's documentation, those of highway-env's quick start."""

BEYOND = 2**64  # larger than every numbered seed
WARM_UP, TIMED = 400, 1600  # steps


@dataclass(frozen=True)
class Training:
    """An agent to be trained and driven.

    Attributes:
        scenario: its name.
        price: lambda [reward per second of planning].
        settings: a name of `SETTINGS`.
        seed: of the network, the exploration and the starts of the training.
        config: further configuration of the environment.
    """

    scenario: str
    price: float
    settings: str = "default"
    seed: int = 0
    config: Mapping[str, Any] = field(default_factory=dict)

    def environment(self) -> gym.Env:
        """Make the environment in which the agent chooses the human model of each step."""
        action = {"type": "HumanModelAction", "lambda": self.price}
        return gym.make(environment_id(self.scenario), config={**self.config, "action": action})

    def agent(self) -> Any:
        """Make the agent, untrained.

        Raises:
            ImportError: without stable-baselines3.
        """
        try:
            import torch
            from stable_baselines3 import DQN
        except ImportError:
            raise ImportError('the peer needs stable-baselines3: pip install "ms-highway[learning]"') from None
        torch.set_num_threads(1)  # more are slower for networks of this size
        env = OwnStarts(self.environment(), self.seed)
        return DQN("MlpPolicy", env, seed=self.seed, device="cpu", **SETTINGS[self.settings])


@dataclass(frozen=True)
class Trained:
    """What an agent chose after its training.

    Attributes:
        steps: of the training.
        seconds: that the training took.
        orders: the rung of every step of an episode, by its seed.
        rewards: the mean of r_R over the steps of an episode, by its seed, as the environment gave it.
    """

    steps: int
    seconds: float
    orders: dict[int, tuple[int, ...]]
    rewards: dict[int, float]


class OwnStarts(gym.Wrapper):
    """Draw the starts of all episodes from a stream of their own, which holds none of the numbered seeds.

    Args:
        env: the environment.
        seed: of the stream; seeds that `reset` is given are ignored.
    """

    def __init__(self, env: gym.Env, seed: int) -> None:
        super().__init__(env)
        self._random = np.random.default_rng(np.random.SeedSequence([BEYOND, seed]))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode from the next seed of the stream."""
        return super().reset(seed=BEYOND + int(self._random.integers(2**63)), options=options)


def steps_per_second(training: Training) -> float:
    """Measure the steps of training that this machine takes in a second, warm, with an agent that is thrown away.

    Raises:
        ImportError: without stable-baselines3.
    """
    agent = training.agent()
    agent.learn(WARM_UP)
    start = perf_counter()
    agent.learn(TIMED, reset_num_timesteps=False)
    agent.get_env().close()
    return TIMED / (perf_counter() - start)


def trained(training: Training, steps: int, seeds: range) -> Trained:
    """Train an agent for so many steps, then let it choose greedily in episodes that it has not seen.

    The same arguments give the same agent on one machine.

    Args:
        training: what is trained.
        steps: of the training; the share of random choices falls with them.
        seeds: of the episodes to be driven.

    Raises:
        ImportError: without stable-baselines3.
    """
    agent, start = training.agent(), perf_counter()
    agent.learn(steps)
    seconds = perf_counter() - start
    agent.get_env().close()
    env = training.environment()
    inner = cast(InteractionEnv, env.unwrapped)
    orders, rewards = {}, {}
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        order: list[int] = []
        earned = 0.0
        while len(order) < inner.episode_steps:
            order.append(int(agent.predict(observation, deterministic=True)[0]))
            observation, _, _, _, info = env.step(order[-1])
            earned += sum(value for name, value in info["rewards"].items() if name != "computation")
        orders[seed], rewards[seed] = tuple(order), earned / len(order)
    env.close()
    return Trained(steps, seconds, orders, rewards)
