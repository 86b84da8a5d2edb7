r"""Let a rule of your own choose between human models of your own, with one human and with two, live and in a batch.

A rule is a frozen dataclass that JAX knows (`ms_highway.metareasoning.rule.Rule`): it looks at the last step and
chooses a rung of the ladder for every human. Its settings name it and make it when an episode starts. A model is a
dataclass as well (`ms_highway.HumanModel`). Run it, or make both known to any command::

    python notebooks/examples/rule.py
    ms-highway --import notebooks.examples.rule compare merger --set ladder=coasting,tom \
      --set costs=coasting=0.09,tom=0.37 --controllers near:6 tom --out results/near
"""

from dataclasses import dataclass, field
from typing import ClassVar

import gymnasium as gym
import jax
import numpy as np
from jax import numpy as jnp

from ms_highway import ControllerSettings, HumanModel, PredictedHuman, add_rule, metareasoning, register
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison


@dataclass(frozen=True)
class Coasting(PredictedHuman):
    """The human takes the foot off the pedal: no control but the friction."""

    name: ClassVar[str] = "coasting"

    def predict(self, game, state, start=None):
        return jnp.zeros((game.planner.horizon, 2))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Near:
    """The top of the ladder for humans within a distance, its first rung for all others."""

    distance: float  # m
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})

    def look(self, game, memory, outcome):
        """Return the distance of every human from the robot, [humans, 1]."""
        robot, humans = outcome.after[0, :2], outcome.after[1 : 1 + game.number, :2]
        return jnp.linalg.norm(humans - robot, axis=1, keepdims=True)

    def choose(self, memory, seen):
        """Choose the rungs of the coming step."""
        return metareasoning.rule.unestimated(memory, jnp.where(seen[:, 0] < self.distance, len(self.ladder) - 1, 0))


class NearSettings(ControllerSettings, frozen=True, tag="near"):
    """What ``{"type": "near", "distance": 6}`` says, and ``near:6``."""

    distance: float  # m

    def rule(self, start):
        return Near(self.distance, start.ladder)


register(Coasting(), before="idm")
add_rule(NearSettings)

if __name__ == "__main__":
    common = {"ladder": ["coasting", "tom"], "costs": {"coasting": 0.09, "tom": 0.37}}
    for scenario, own in {"merger": {}, "dense_merge": {"humans": 2}}.items():
        config = {**common, **own, "controller": {"type": "near", "distance": 6}}
        env = gym.make(f"ms_highway:ms-highway/{scenario.replace('_', '-')}-v0", config=config)
        env.reset(seed=0)
        rewards, models, done = [], [], False
        while not done:
            _, reward, terminated, truncated, info = env.step(0)
            done = terminated or truncated
            rewards.append(reward)
            models += info["models"]
        print(f"{scenario}: reward per step {np.mean(rewards):.2f}, tom in {np.mean(np.array(models) == 'tom'):.0%}")

        records = simulated(Comparison({scenario: ["near:6"]}, seeds=20, config=common | own))
        used = np.mean(records["model"] == "tom")
        print(f"20 episodes at once: reward per step {records['reward'].mean():.2f}, tom in {used:.0%}")
