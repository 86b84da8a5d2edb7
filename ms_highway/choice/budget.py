"""Choose the rungs that gain most together within the time of a cycle."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.choice.quadratic import Quadratic
from ms_highway.choice.rule import NOT_ESTIMATED, Decision, Memory, Outcome, Rule
from ms_highway.game.game import Game
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Gains, Index, Rungs, Scalar

PLANNABLE_SHARE = 0.8
"""Share of a budget that decision and plan may need; the rest is for times above the quantile that was measured.

Measured in 40 episodes of Dense Merge: with a share of 1, a budget of 5 ms is late in 47 % of the steps."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Budget(Rule):
    """Maximise the summed gains of all humans, subject to ``deciding + base + sum_i each[rung_i] <= share seconds``.

    Where even the first rungs do not fit, they are chosen all the same.

    Attributes:
        gains: rule that estimates the gain of each rung, without a price; its own choice is not used.
        costs: of plans; a high quantile, if plans are to be in time.
        seconds: of a cycle.
        share: of it that may be planned for.
        deciding: seconds of a decision; drivers measure them before their first step.
    """

    gains: Rule
    costs: Costs
    seconds: Scalar
    share: Scalar = PLANNABLE_SHARE
    deciding: Scalar = 0.0

    @property
    def ladder(self) -> tuple[HumanModel, ...]:
        """Human models, cheapest first."""
        return self.gains.ladder

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Choose the best rungs within the time that is left; rungs without an estimate are not chosen."""
        decision = self.gains.decide(game, memory, outcome)
        known = jnp.isfinite(decision.gains)
        values = jnp.where(known, jnp.asarray(decision.gains), -jnp.inf)
        values = values.at[:, 0].set(jnp.where(known[:, 0], values[:, 0], 0.0))
        capacity = self.share * self.seconds - self.deciding - self.costs.base
        rungs = best_rungs(values, self.costs.each, capacity)
        return decision._replace(memory=decision.memory._replace(rungs=rungs))

    def deciding_in(self, seconds: Callable[[], float]) -> Rule:
        """Return the rule with measured decision seconds, unless it has some already."""
        return self if np.any(self.deciding) else replace(self, deciding=seconds())


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OneStepGains(Rule):
    """Estimate in every step what the top of the ladder gains over its first rung for every human, by Algorithm 1.

    Algorithm 1 runs on a ladder of these two, with costs and cooldown of zero. It estimates the robot's reward in the
    last step under the other one. Rungs between are not estimated: their prediction takes as long as a plan.
    Nothing is chosen; for `Budget`.

    Attributes:
        switching: its costs, price and cooldown are not used.
    """

    switching: Quadratic

    @property
    def ladder(self) -> tuple[HumanModel, ...]:
        """Human models, cheapest first."""
        return self.switching.ladder

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Estimate the gains, and keep the rungs; before the first step, the gains are unknown."""
        two, free = (self.ladder[0], self.ladder[-1]), Costs(0.0, np.zeros(2))
        rule = replace(self.switching, costs=free, price=0.0, ladder=two, cooldown=0)
        on_top = jnp.asarray(memory.rungs) == len(self.ladder) - 1
        first = memory._replace(rungs=on_top.astype(int), last_check=memory.last_check[:, :2])
        down, up = jnp.moveaxis(rule.decide(game, first, outcome).gains, 1, 0)
        gains = jnp.where(on_top, -down, up)
        known = jnp.isfinite(gains)
        estimates = jnp.full(jnp.shape(memory.last_check), NOT_ESTIMATED)
        estimates = estimates.at[:, -1].set(jnp.where(known, gains, NOT_ESTIMATED))
        return Decision(memory, estimates.at[:, 0].set(jnp.where(known, 0.0, NOT_ESTIMATED)), jnp.bool(False))


def best_rungs(values: Gains, costs: Float[Array, "rungs"], capacity: Scalar) -> Rungs:
    """Return the rungs of the highest summed value whose summed cost is within a capacity; of equals, the cheapest.

    Costs are the same for all humans, so they follow from how many humans have each rung: a dynamic programme over
    these counts is exact for any costs. For h humans and r rungs, it keeps a table of (h + 1)^(r - 1) values.

    Args:
        values: of each rung for each human; minus infinity where a rung is impossible.
        costs: of each rung; infinite or NaN where a rung is impossible.
        capacity: most cost of all together.

    Returns:
        The rungs; the first one for every human where nothing fits.
    """
    humans, rungs = values.shape
    counts = jnp.indices((humans + 1,) * (rungs - 1))  # of humans with each rung above the first
    counts = jnp.concatenate([humans - counts.sum(axis=0, keepdims=True), counts])
    each = jnp.asarray(costs).reshape(-1, *[1] * (rungs - 1))
    cost = jnp.where(counts == 0, 0.0, counts * each).sum(axis=0)

    def add(table: Float[jax.Array, "*counts"], human: Float[jax.Array, "rungs"]) -> tuple[jax.Array, jax.Array]:
        before = jnp.stack([table, *(_one_more(table, axis) for axis in range(rungs - 1))])
        options = before + human.reshape(each.shape)
        return options.max(axis=0), options.argmax(axis=0)

    nobody = jnp.where(counts[0] == humans, 0.0, -jnp.inf)
    table, choices = jax.lax.scan(add, nobody, values)
    value = jnp.where((cost <= capacity) & (cost < jnp.inf), table, -jnp.inf)
    place = jnp.argmin(jnp.where(value == value.max(), cost, jnp.inf))

    def take(place: Index, chosen: Int[jax.Array, "*counts"]) -> tuple[jax.Array, jax.Array]:
        rung = chosen.ravel()[place]
        return place - steps[rung], rung

    steps = jnp.array([0, *((humans + 1) ** (rungs - 2 - axis) for axis in range(rungs - 1))])
    _, best = jax.lax.scan(take, place, choices, reverse=True)
    return jnp.where(value.max() > -jnp.inf, best, 0)


def _one_more(table: Float[jax.Array, "*counts"], axis: int) -> Float[jax.Array, "*counts"]:
    """Shift a table by one along an axis: nobody had one more before the first."""
    first = jnp.expand_dims(jnp.full_like(jax.lax.index_in_dim(table, 0, axis, keepdims=False), -jnp.inf), axis)
    return jnp.concatenate([first, jax.lax.slice_in_dim(table, 0, -1, axis=axis)], axis=axis)
