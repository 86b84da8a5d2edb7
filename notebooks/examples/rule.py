r"""Let a rule of your own choose between human models of your own.

It chooses with one human and with two, live and in a batch. There are two kinds of
rules. A chooser picks the models, such as ``near:6``. An estimator says what models
gain, which is then weighed against their time at a lambda, such as ``closeness:2``. All
are known to a command as well::

    ms-highway --import notebooks.examples.rule compare merger \
      --set ladder=coasting,tom \
      --set costs=coasting=0.09,tom=0.37 --controllers near:6 closeness:2 tom \
      --out results/near
"""

from dataclasses import dataclass

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


def distances(evidence):
    game = evidence.game
    state = evidence.outcome.after
    return jnp.linalg.norm(state[1 : 1 + game.number, :2] - state[0, :2], axis=1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Near(ms_highway.Chooser, tag="near"):  # in short near:6
    # m, within which humans are predicted by the top of the ladder, others by its first
    # rung
    distance: float

    def choose(self, memory, gains, costs, evidence):
        return jnp.where(
            distances(evidence) < self.distance, len(evidence.ladder) - 1, 0
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Closeness(ms_highway.Estimator, tag="closeness"):  # in short closeness:2
    reach: float = (
        10.0  # m, at which a better prediction gains 1 / e of what it gains at contact
    )

    def estimate(self, memory, evidence):
        above_first = jnp.arange(len(evidence.ladder))
        gains = jnp.exp(-distances(evidence) / self.reach)[:, None] * above_first
        return ms_highway.Estimate(gains, False)


ms_highway.register(Coasting(), before="idm")
ms_highway.add_rule(Near)
ms_highway.add_rule(Closeness)
if __name__ == "__main__":
    models = {"ladder": ["coasting", "tom"], "costs": {"coasting": 0.09, "tom": 0.37}}
    for scenario, config in (
        ("merger", models),
        ("dense_merge", models | {"humans": 2}),
    ):
        for rule in ("near:6", "closeness:2"):
            live = pd.DataFrame(episode(make_environment(scenario, rule, **config), 0))
            batch = simulated(Comparison({scenario: [rule]}, seeds=20, config=config))
            for steps in (live, batch):
                used = (steps["model"] == "tom").mean()
                print(
                    f"{scenario}, {rule}: reward per step {steps['reward'].mean():.2f},"
                    f" tom in {used:.0%}"
                )
