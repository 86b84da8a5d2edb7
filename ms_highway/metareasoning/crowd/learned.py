"""Decide for every human of a crowd which model is worth its time, by a learned value of computation.

The value of predicting a human by a dearer model is what the robot earns more, per step, than with a naive prediction
of this human, the others predicted as they are, less lambda for the time that the human adds to a plan.
"""

from dataclasses import dataclass

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.crowd import Crowd
from ms_highway.metareasoning.crowd.rule import CrowdCosts, CrowdDecision, CrowdMemory, CrowdOutcome
from ms_highway.metareasoning.crowd.situation import describe_humans
from ms_highway.metareasoning.learned_value import Network, outputs
from ms_highway.planning.crowd import NAIVE
from ms_highway.runtime.arrays import Array

__all__ = ["LearnedCrowdValue"]

CAUTION = 0.5  # standard deviations among the networks


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LearnedCrowdValue:
    """Take for every human the rung of the highest value.

    Attributes:
        costs: planning time, of which ``each`` counts.
        price: lambda, reward per second of planning.
        network: estimates the gain of every rung but the first, reward per step, from `describe_humans`.
        centre, spread: of the inputs, by which they are standardised.
    """

    costs: CrowdCosts
    price: float | Float[Array, ""]
    network: Network
    centre: Float[Array, "inputs"]
    spread: Float[Array, "inputs"]

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """Choose from the state after the last step; naive predictions where estimates are not finite.

        A gain counts less `CAUTION` standard deviations among the networks: in doubt, a human is predicted naively.
        """
        inputs = (describe_humans(crowd, outcome.after) - self.centre) / self.spread
        means, _ = jax.vmap(lambda one: outputs(self.network, one))(inputs)  # [humans, networks, rungs - 1]
        nothing = jnp.zeros((crowd.humans, 1))
        gains = jnp.concatenate([nothing, jnp.mean(means, axis=1)], axis=1)
        doubts = jnp.concatenate([nothing, jnp.std(means, axis=1)], axis=1)
        known = jnp.isfinite(gains).all(axis=1)
        values = gains - CAUTION * doubts - self.price * jnp.asarray(self.costs.each)
        rungs = jnp.where(known, jnp.argmax(values, axis=1), NAIVE).astype(jnp.int32)
        return CrowdDecision(memory._replace(rungs=rungs, step=memory.step + 1), gains, ~known.all())
