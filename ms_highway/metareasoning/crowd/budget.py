"""Choose the rungs that gain most together within the time of a cycle."""

from dataclasses import dataclass

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.crowd import Crowd
from ms_highway.metareasoning.crowd.knapsack import best_rungs
from ms_highway.metareasoning.crowd.rule import CrowdDecision, CrowdMemory, CrowdOutcome, CrowdRule
from ms_highway.planning.compiled_crowd import CrowdCosts
from ms_highway.runtime.arrays import Array

__all__ = ["SHARE", "Budget"]

SHARE = 0.8
"""Share of a budget that decision and plan may need; the rest is for times above the quantile that was measured."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Budget:
    """Maximise the summed gains of all humans, subject to ``deciding + base + sum_i each[rung_i] <= share seconds``.

    Where even naive predictions do not fit, they are chosen all the same.

    Attributes:
        gains: rule that estimates the gain of each rung over naive, without a price; its own choice is not used.
        costs: of plans; a high quantile, if plans are to be in time.
        seconds: of a cycle.
        share: of it that may be planned for.
        deciding: seconds of a decision; drivers measure them before their first step.
    """

    gains: CrowdRule
    costs: CrowdCosts
    seconds: float | Float[Array, ""]
    share: float | Float[Array, ""] = SHARE
    deciding: float | Float[Array, ""] = 0.0

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """See `ms_highway.metareasoning.crowd.rule.CrowdRule`; rungs without an estimate are not chosen."""
        decision = self.gains.choose(crowd, memory, outcome)
        known = jnp.isfinite(decision.gains)
        values = jnp.where(known, jnp.asarray(decision.gains), -jnp.inf)
        values = values.at[:, 0].set(jnp.where(known[:, 0], values[:, 0], 0.0))
        capacity = self.share * self.seconds - self.deciding - self.costs.base
        rungs = best_rungs(values, self.costs.each, capacity)
        return decision._replace(memory=decision.memory._replace(rungs=rungs))
