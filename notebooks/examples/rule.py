r"""Let a rule of your own choose between human models of your own, with one human and with two, live and in a batch.

Both are known to a command as well::

    ms-highway --import notebooks.examples.rule compare merger --set ladder=coasting,tom \
      --set costs=coasting=0.09,tom=0.37 --controllers near:6 tom --out results/near
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import pandas as pd

import ms_highway
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import episode, make_environment


@dataclass(frozen=True)
class Coasting(ms_highway.PredictedHuman):
    name = "coasting"  # the human takes the foot off the pedal

    def predict(self, game, state, start=None):
        return jnp.zeros((game.planner.horizon, 2))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Near(ms_highway.Rule):
    distance: float  # m, within which humans are predicted by the top of the ladder, others by its first rung
    ladder: tuple[ms_highway.HumanModel, ...] = field(metadata={"static": True})

    def decide(self, game, memory, outcome):
        humans, robot = outcome.after[1 : 1 + game.number, :2], outcome.after[0, :2]
        near = jnp.linalg.norm(humans - robot, axis=1) < self.distance
        return ms_highway.unestimated(memory, jnp.where(near, len(self.ladder) - 1, 0))


class NearSettings(ms_highway.ControllerSettings, frozen=True, tag="near"):  # in short near:6
    distance: float

    def rule(self, start):
        return Near(self.distance, start.ladder)


ms_highway.register(Coasting(), before="idm")
ms_highway.add_rule(NearSettings)
if __name__ == "__main__":
    models = {"ladder": ["coasting", "tom"], "costs": {"coasting": 0.09, "tom": 0.37}}
    for scenario, config in (("merger", models), ("dense_merge", models | {"humans": 2})):
        live = pd.DataFrame(episode(make_environment(scenario, "near:6", **config), 0))
        batch = simulated(Comparison({scenario: ["near:6"]}, seeds=20, config=config))
        for steps in (live, batch):
            used = (steps["model"] == "tom").mean()
            print(f"{scenario}: reward per step {steps['reward'].mean():.2f}, tom in {used:.0%}")
