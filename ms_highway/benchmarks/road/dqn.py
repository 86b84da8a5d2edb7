"""DQN of stable-baselines3 as a driver of stock scenes, in the setting of highway-env's documentation."""

from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium as gym

from ms_highway.benchmarks.dqn_peer import SETTINGS, OwnStarts
from ms_highway.benchmarks.road.peers import Peer
from ms_highway.runtime.files import replacing

__all__ = ["Dqn"]


class Dqn(Peer):
    """Choose meta-actions greedily as an agent that was trained in the same scene, in episodes of its own.

    Args:
        env: the environment, with discrete actions.
        steps: number of steps of the training.
        models: directory in which trained agents are kept, one file per scene and number of steps.

    Raises:
        ImportError: without stable-baselines3.
    """

    def __init__(self, env: gym.Env, steps: int, models: Path) -> None:
        super().__init__(env)
        scene = env.spec.id if env.spec else type(env.unwrapped).__name__
        self.steps = steps
        traffic = str(env.unwrapped.config["other_vehicles_type"]).rpartition(".")[2]  # type: ignore[attr-defined]
        self.file = models / f"{scene}_{traffic}_{steps}_steps.zip"
        self.agent  # noqa: B018  # trained before the first episode, which is timed

    @cached_property
    def agent(self) -> Any:
        """The trained agent, from its file if there is one."""
        import torch
        from stable_baselines3 import DQN

        torch.set_num_threads(1)  # more are slower for networks of this size
        if not self.file.exists():
            agent = DQN("MlpPolicy", OwnStarts(self.env, 0), seed=0, device="cpu", **SETTINGS["highway-env"])
            agent.learn(self.steps)
            with replacing(self.file) as path:
                agent.save(path)
        return DQN.load(self.file, device="cpu")

    def choose(self) -> Any:
        """Return the agent's action."""
        return int(self.agent.predict(self.observation, deterministic=True)[0])
