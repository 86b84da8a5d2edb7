"""Let a rule of your own choose between human models of your own, with one human and with two, live and in a batch.

A rule is a frozen dataclass that JAX knows (`ms_highway.metareasoning.rule.Rule`): it looks at the last step and
chooses a rung of the ladder for every human. A model is one as well (`ms_highway.HumanModel`). `notebooks/MAP.md` says
how to give both a short name. Run::

    python notebooks/examples/rule.py
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import gymnasium as gym
import jax
import numpy as np
from jax import numpy as jnp

from ms_highway import Driver, HumanModel, PredictedHuman, TheoryOfMind, metareasoning, simulation
from ms_highway.experiments.batch import make_batch
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


rule = Near(6.0, (Coasting(), TheoryOfMind()))
for scenario, config in {"merger": {}, "dense_merge": {"humans": 2, "horizon": 5, "costs": "published"}}.items():
    env = gym.make(f"ms_highway:ms-highway/{scenario.replace('_', '-')}-v0", config=config).unwrapped
    env.reset(seed=0)
    env.robot.drive_with(Driver(env.game, rule), env.robot.companions)
    rewards, models, done = [], [], False
    while not done:
        _, reward, terminated, truncated, info = env.step(0)
        done = terminated or truncated
        rewards.append(reward)
        models += info["models"]
    print(f"{scenario}: reward per step {np.mean(rewards):.2f}, tom in {np.mean(np.array(models) == 'tom'):.0%}")

    batch = make_batch(Comparison({scenario: ["naive"]}, seeds=20, config=config), scenario)
    episodes = batch.episodes(batch.keys())
    episodes = replace(episodes, schedules=np.full_like(episodes.schedules, simulation.records.DECIDES))
    records = simulation.loop.simulate(replace(batch.loop, rule=rule), episodes)
    used = np.mean(records.rungs == len(rule.ladder) - 1)
    print(f"20 episodes at once: reward per step {records.reward.mean():.2f}, tom in {used:.0%}")
