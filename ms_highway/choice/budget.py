"""Choose the rungs with the highest total gain within the time of a cycle.

It is a knapsack problem: every human gets one rung, and the times of the rungs add up.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar

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
from ms_highway.choice.situation import distance_rank
from ms_highway.planning.costs import Costs
from ms_highway.runtime.arrays import Array, Gains, Rungs, Scalar
from ms_highway.runtime.limits import Positive


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Knapsack(Chooser[Evidence]):
    """Maximise the total gain for all humans within the time of a cycle.

    The time of decision and plan, ``deciding + base + sum_i each[rung_i]``, is at most
    ``share`` of the cycle. If not even the first rungs fit, they are chosen all the
    same. Above the first rung, none is chosen without an estimate. The costs are
    planning times; high quantiles, if plans have to be in time.

    Gains are added up for any mixture of rungs. Those of
    `ms_highway.choice.learned_value` hold only while all nearer humans have the same
    rung, so that their sum is an approximation here.

    Attributes:
        milliseconds: duration of a cycle [ms], in which decision and plan take place.
        share: share of the cycle that they may take. The rest is a margin for times
            above the measured quantile: with a share of 1, plans within a budget of 5
            ms were late in 47 % of the steps of 40 episodes of Dense Merge.
        deciding: duration of a decision [s]; drivers measure it before their first
            step, see `deciding_in`.
    """

    milliseconds: Positive
    share: Scalar = field(default=0.8, metadata=FROM_START)
    deciding: Scalar = field(default=0.0, metadata=FROM_START)

    @property
    def seconds(self) -> Scalar:
        """Duration of a cycle [s]."""
        return self.milliseconds * 1e-3

    def choose(
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: Evidence,
    ) -> Rungs:
        """Choose the best rungs for the time that is left."""
        # Gains of the rungs that may be chosen: those with an estimate.
        gains = jnp.asarray(gains)
        known = jnp.isfinite(gains)
        values = jnp.where(known, gains, -jnp.inf)

        # The first rung can always be chosen; without an estimate, it is worth 0.
        first = jnp.where(known[:, 0], gains[:, 0], 0.0)
        values = values.at[:, 0].set(first)

        capacity = self.share * self.seconds - self.deciding - costs.base
        return best_rungs(values, costs.each, capacity)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Budget(Knapsack[GameEvidence]):
    """Fill the time of a cycle in a game; time to spare goes to the nearest humans.

    If the top rung gains next to nothing for a human, a small gain replaces that, which
    is larger for nearer humans.

    Attributes:
        little_gain: gain in reward per step below which the top rung counts as gaining
            nothing. For the same reason, it is the least noise that networks predict,
            see `ms_highway.choice.learned_value.noise`.
    """

    little_gain: ClassVar[float] = 0.02

    def choose(
        self,
        memory: Memory,
        gains: Gains,
        costs: Costs,
        evidence: GameEvidence,
    ) -> Rungs:
        """Choose the best rungs for the time that is left."""
        # Small gains, from `little_gain` for the nearest human down to almost 0.
        rank = distance_rank(evidence.game, evidence.outcome.after)
        share_nearer = rank / evidence.game.number
        small_gain = self.little_gain * (1 - share_nearer)

        # They stand for the gains of the top rung that are next to nothing.
        gains = jnp.asarray(gains)
        top = gains[:, -1]
        is_little = jnp.abs(top) < self.little_gain
        gains = gains.at[:, -1].set(jnp.where(is_little, small_gain, top))
        return super().choose(memory, gains, costs, evidence)


def deciding_in(rule: Rule[Evidence], seconds: Callable[[], float]) -> Rule[Evidence]:
    """Return the rule with the seconds of a decision, if its chooser counts them.

    A rule that knows them already is returned as it is.

    Args:
        rule: rule that decides.
        seconds: measures the seconds; called only if they are needed.
    """
    chooser = rule.chooser
    if not isinstance(chooser, Knapsack) or np.any(chooser.deciding):
        return rule
    return replace(rule, chooser=replace(chooser, deciding=seconds()))


def best_rungs(values: Gains, costs: Float[Array, "rungs"], capacity: Scalar) -> Rungs:
    """Return the rungs with the highest total value within a capacity.

    Of equally good ones, the cheapest are returned.

    Costs are the same for all humans, so the total cost depends only on how many humans
    have each rung. A dynamic programme over these counts is therefore exact for any
    costs. For h humans and r rungs, it keeps a table of (h + 1)^(r - 1) values V, whose
    axes n are the counts of humans on each rung above the first. With one human more::

        V_i(n) = max over rungs k of V_(i-1)(n with one less on k) + values[i, k]

    Args:
        values: value of each rung for each human; minus infinity if the rung is
            impossible.
        costs: cost of each rung; infinite or NaN if the rung is impossible.
        capacity: largest total cost.

    Returns:
        The rungs; the first one for every human if nothing fits.
    """
    humans, rungs = values.shape
    axes = rungs - 1

    # Count of humans on each rung, at every place of the table: [rungs, *table].
    above_first = jnp.indices((humans + 1,) * axes)
    on_first = humans - above_first.sum(axis=0, keepdims=True)
    counts = jnp.concatenate([on_first, above_first])

    # Total cost at every place of the table. A rung that nobody has costs nothing, even
    # if it is impossible.
    per_rung = (-1,) + (1,) * axes  # the shape [rungs, *table], with 1 for the table
    each = jnp.asarray(costs).reshape(per_rung)
    cost_by_rung = jnp.where(counts == 0, 0.0, counts * each)
    cost = cost_by_rung.sum(axis=0)

    # Add one human after the other: V_i(n), and the rung k that attains it.
    def add(
        table: Float[jax.Array, "*counts"],
        human: Float[jax.Array, "rungs"],
    ) -> tuple[jax.Array, jax.Array]:
        before = [table]
        for axis in range(axes):
            one_less = jnp.roll(table, 1, axis)
            nobody_on_rung = counts[1 + axis] == 0
            before.append(jnp.where(nobody_on_rung, -jnp.inf, one_less))
        options = jnp.stack(before) + human.reshape(each.shape)
        return options.max(axis=0), options.argmax(axis=0)

    nobody = jnp.where(counts[0] == humans, 0.0, -jnp.inf)
    table, choices = jax.lax.scan(add, nobody, jnp.asarray(values))

    # Find the best place of the table within the capacity; of equals, the cheapest.
    fits = (cost <= capacity) & (cost < jnp.inf)
    value = jnp.where(fits, table, -jnp.inf)
    is_best = value == value.max()
    cost_of_best = jnp.where(is_best, cost, jnp.inf)
    best_place = jnp.argmin(cost_of_best)

    # Go back from there, from the last human to the first. In the ravelled table, one
    # human less on a rung is one stride before; the first rung has no axis.
    strides = [0]
    for axis in range(axes):
        later_axes = axes - 1 - axis
        strides.append((humans + 1) ** later_axes)
    stride = jnp.array(strides)

    def take(
        place: jax.Array,
        chosen: Int[jax.Array, "*counts"],
    ) -> tuple[jax.Array, jax.Array]:
        rung = chosen.ravel()[place]
        return place - stride[rung], rung

    _, best = jax.lax.scan(take, best_place, choices, reverse=True)
    anything_fits = value.max() > -jnp.inf
    return jnp.where(anything_fits, best, 0)
