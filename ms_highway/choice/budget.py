"""Choose the rungs with the highest total gain within the time of a cycle."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.choice.rule import (
    FROM_START,
    Chooser,
    Evidence,
    GameEvidence,
    Memory,
    Rule,
)
from ms_highway.choice.situation import nearness
from ms_highway.planning.costs import Costs
from ms_highway.runtime.arrays import Array, Gains, Rungs, Scalar
from ms_highway.runtime.limits import Positive

PLANNABLE_SHARE = 0.8
"""Share of a budget that decision and plan may take. The rest is a margin for times
above the measured quantile.

With a share of 1, plans within a budget of 5 ms were late in 47 % of the steps of 40
episodes of Dense Merge.
"""

LITTLE_GAIN = 0.02
"""Gain per step below which the top rung counts as gaining nothing; the least standard
deviation of a learned gain."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Knapsack(Chooser[Evidence]):
    """Maximise the total gain for all humans, subject to ``deciding + base + sum_i
    each[rung_i] <= share cycle``.

    If not even the first rungs fit, they are chosen all the same. Above the first rung,
    none is chosen without an estimate. The costs are planning times; high quantiles, if
    plans have to be in time.

    Attributes:
        milliseconds: duration of a cycle [ms], in which decision and plan take place.
        share: share of the cycle that they may take.
        deciding: duration of a decision [s]; drivers measure it before their first
            step, see `deciding_in`.
    """

    milliseconds: Positive
    share: Scalar = field(default=PLANNABLE_SHARE, metadata=FROM_START)
    deciding: Scalar = field(default=0.0, metadata=FROM_START)

    @property
    def seconds(self) -> float:
        """Duration of a cycle [s]."""
        return self.milliseconds * 1e-3

    def choose(
        self, memory: Memory, gains: Gains, costs: Costs, evidence: Evidence
    ) -> Rungs:
        """Choose the best rungs for the time that is left."""
        gains = jnp.asarray(gains)
        known = jnp.isfinite(gains)
        values = jnp.where(known, gains, -jnp.inf)
        values = values.at[:, 0].set(jnp.where(known[:, 0], gains[:, 0], 0.0))
        capacity = self.share * self.seconds - self.deciding - costs.base
        return best_rungs(values, costs.each, capacity)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Budget(Knapsack[GameEvidence]):
    """The same in a game, where time to spare goes to the nearest humans.

    If the top rung gains next to nothing for a human, a small gain replaces that, which
    is larger for nearer humans.
    """

    def choose(
        self, memory: Memory, gains: Gains, costs: Costs, evidence: GameEvidence
    ) -> Rungs:
        """Choose the best rungs for the time that is left."""
        rank = nearness(evidence.game, evidence.outcome.after)
        little = LITTLE_GAIN * (1 - rank / evidence.game.number)
        gains = jnp.asarray(gains)
        top = gains[:, -1]
        gains = gains.at[:, -1].set(jnp.where(jnp.abs(top) < LITTLE_GAIN, little, top))
        return super().choose(memory, gains, costs, evidence)


def deciding_in(rule: Rule[Evidence], seconds: Callable[[], float]) -> Rule[Evidence]:
    """Return the rule with the seconds of a decision, if its chooser counts them and
    does not know them yet.

    Args:
        rule: that decides.
        seconds: measures them; not called for another rule.
    """
    chooser = rule.chooser
    if not isinstance(chooser, Knapsack) or np.any(chooser.deciding):
        return rule
    return replace(rule, chooser=replace(chooser, deciding=seconds()))


def best_rungs(values: Gains, costs: Float[Array, "rungs"], capacity: Scalar) -> Rungs:
    """Return the rungs with the highest total value whose total cost is within a
    capacity; of equals, the cheapest.

    Costs are the same for all humans, so the total cost depends only on how many humans
    have each rung. A dynamic programme over these counts is therefore exact for any
    costs. For h humans and r rungs, it keeps a table of (h + 1)^(r - 1) values.

    Args:
        values: value of each rung for each human; minus infinity if the rung is
            impossible.
        costs: cost of each rung; infinite or NaN if the rung is impossible.
        capacity: largest total cost.

    Returns:
        The rungs; the first one for every human if nothing fits.
    """
    humans, rungs = values.shape
    counts = jnp.indices(
        (humans + 1,) * (rungs - 1)
    )  # number of humans with each rung above the first
    counts = jnp.concatenate([humans - counts.sum(axis=0, keepdims=True), counts])
    each = jnp.asarray(costs).reshape(-1, *[1] * (rungs - 1))
    cost = jnp.where(counts == 0, 0.0, counts * each).sum(axis=0)

    def add(
        table: Float[jax.Array, "*counts"], human: Float[jax.Array, "rungs"]
    ) -> tuple[jax.Array, jax.Array]:
        before = [table]
        for axis in range(rungs - 1):
            one_less = jnp.roll(table, 1, axis)  # humans had this rung before
            before.append(jnp.where(counts[1 + axis] == 0, -jnp.inf, one_less))
        options = jnp.stack(before) + human.reshape(each.shape)
        return options.max(axis=0), options.argmax(axis=0)

    nobody = jnp.where(counts[0] == humans, 0.0, -jnp.inf)
    table, choices = jax.lax.scan(add, nobody, jnp.asarray(values))
    value = jnp.where((cost <= capacity) & (cost < jnp.inf), table, -jnp.inf)
    place = jnp.argmin(jnp.where(value == value.max(), cost, jnp.inf))

    def take(
        place: jax.Array, chosen: Int[jax.Array, "*counts"]
    ) -> tuple[jax.Array, jax.Array]:
        rung = chosen.ravel()[place]
        return place - steps[rung], rung

    steps = jnp.array(
        [0, *((humans + 1) ** (rungs - 2 - axis) for axis in range(rungs - 1))]
    )
    _, best = jax.lax.scan(take, place, choices, reverse=True)
    return jnp.where(value.max() > -jnp.inf, best, 0)
