"""Let a decision rule of your own choose the human model: the dearest within 6 m of the human, the cheapest beyond.

A rule is a controller (`ms_highway.control.controller.Controller`): here a `ms_highway.FixedModel` that replaces its
model between steps. `notebooks/MAP.md` says how to give a rule a short name for commands. Run::

    python notebooks/examples/rule.py
"""

import gymnasium as gym
import numpy as np

from ms_highway import FixedModel


class NearModel(FixedModel):
    """Plans with the top of the ladder near the partner, and with the bottom elsewhere."""

    def step(self, state, before=None):
        distance = np.hypot(*(state[1, :2] - state[0, :2]))  # m, from the robot to its partner
        self.model = self.ladder[-1 if distance < 6 else 0]
        return super().step(state, before)


env = gym.make("ms_highway:ms-highway/merger-v0").unwrapped
env.reset(seed=0)
rule = NearModel(env.game, env.models[0], ladder=env.models)
env.robot.drive_with(rule, env.robot.companions)
rewards, models, done = [], [], False
while not done:
    _, reward, terminated, truncated, info = env.step(0)
    done = terminated or truncated
    rewards.append(reward)
    models.append(info["model"])
print(f"reward per step {np.mean(rewards):.2f}, tom in {models.count('tom')} of {len(models)} steps")
