"""Let a decision rule of your own choose the human models: the most expensive for humans within 6 m, else the cheapest.

A rule is a frozen dataclass that JAX knows (`ms_highway.metareasoning.rule.Rule`): it looks at the last step and
chooses a rung of the ladder for every human, one or several. `notebooks/MAP.md` says how to give it a short name. Run::

    python notebooks/examples/rule.py
"""

from dataclasses import dataclass, field
from math import nan
from typing import ClassVar

import gymnasium as gym
import jax
import numpy as np
from jax import numpy as jnp

from ms_highway import Costs, Driver, HumanModel, metareasoning


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Near:
    """The top of the ladder for humans within a distance, its first rung for all others."""

    distance: float  # m
    costs: Costs
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    price: ClassVar[float] = nan  # nothing is decided by a price
    network: ClassVar[None] = None
    in_one_kernel: ClassVar[bool] = False

    def look(self, game, memory, outcome):
        """Return the distance of every human from the robot, [humans, 1]."""
        robot, humans = outcome.after[0, :2], outcome.after[1 : 1 + game.number, :2]
        return jnp.linalg.norm(humans - robot, axis=1, keepdims=True)

    def choose(self, memory, seen):
        """Choose the rungs of the coming step."""
        return metareasoning.rule.unestimated(memory, jnp.where(seen[:, 0] < self.distance, len(self.ladder) - 1, 0))


env = gym.make("ms_highway:ms-highway/merger-v0").unwrapped  # or dense-merge-v0, with several humans
env.reset(seed=0)
rule = Near(6.0, env.costs(env.car_states), env.settings.models)
env.robot.drive_with(Driver(env.game, rule), env.robot.companions)
rewards, models, done = [], [], False
while not done:
    _, reward, terminated, truncated, info = env.step(0)
    done = terminated or truncated
    rewards.append(reward)
    models.append(info["model"])
print(f"reward per step {np.mean(rewards):.2f}, tom in {models.count('tom')} of {len(models)} steps")
