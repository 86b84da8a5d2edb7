"""Choose a model for each car of the traffic: the gain that its response may bring, against the time of the model.

Proposals are first scored with all cars under the first model of the ladder. How much more the best of them would earn
without car i is an upper bound on the gain of any better prediction of this car: ``max_p (R(p) + c_i(p)) - max_p
R(p)``, where proposal p earns R(p), and c_i(p) is the cost of car i in it. The rules here receive these bounds in place
of an outcome. `ms_highway.choice.rule.Order` needs none, and `ms_highway.choice.budget.Budget` chooses by `Bounds`.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
from jax import numpy as jnp

from ms_highway.choice.rule import NOT_ESTIMATED, Decision, Memory, Rule
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import PerHuman, Scalar


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bounds(Rule):
    """Take the bounds as gains of the last model over the first, without a choice.

    Attributes:
        ladder: models, cheapest first (static).
    """

    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})

    def decide(self, game: Any, memory: Memory, outcome: PerHuman) -> Decision:
        """Keep the rungs; models between the first and the last are not estimated."""
        gains = jnp.full(memory.last_check.shape, NOT_ESTIMATED).at[:, 0].set(0.0).at[:, -1].set(outcome)
        return Decision(memory, gains, jnp.bool(False))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Priced(Rule):
    """Predict each car by the most expensive model whose time costs no more than a better prediction could gain.

    Attributes:
        ladder: models, cheapest first (static).
        costs: of plans.
        price: lambda [reward per second].
    """

    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    costs: Costs
    price: Scalar

    def decide(self, game: Any, memory: Memory, outcome: PerHuman) -> Decision:
        """Choose by the bounds; the first model is always worth its time."""
        gains = jnp.asarray(outcome)[:, None] - self.price * jnp.asarray(self.costs.each)
        rungs = jnp.where(gains >= 0, jnp.arange(len(self.ladder)), 0).max(axis=1)
        return Decision(memory._replace(rungs=rungs), gains, jnp.bool(False))
