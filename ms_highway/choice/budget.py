"""Choose the rungs with the highest total gain within the time of a cycle."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.choice.quadratic import Quadratic
from ms_highway.choice.rule import NOT_ESTIMATED, Decision, Memory, Outcome, Rule
from ms_highway.game.game import Game
from ms_highway.planning.costs import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Gains, Index, Rungs, Scalar

PLANNABLE_SHARE = 0.8
"""Share of a budget that decision and plan may take. The rest is a margin for times above the measured quantile.

With a share of 1, plans within a budget of 5 ms were late in 47 % of the steps of 40 episodes of Dense Merge."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Budget(Rule):
    """Maximise the total gain for all humans, subject to ``deciding + base + sum_i each[rung_i] <= share seconds``.

    If not even the first rungs fit, they are chosen all the same.

    Attributes:
        gains: rule that estimates the gain of each rung, without a price; its own choice is not used.
        costs: planning times [s]; high quantiles, if plans have to be in time.
        seconds: duration of a cycle [s].
        share: share of the cycle that decision and plan may take.
        deciding: duration of a decision [s]; drivers measure it before their first step.
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
        """Choose the best rungs for the time that is left, but none above the first without an estimate."""
        decision = self.gains.decide(game, memory, outcome)
        known = jnp.isfinite(decision.gains)
        values = jnp.where(known, jnp.asarray(decision.gains), -jnp.inf)
        values = values.at[:, 0].set(jnp.where(known[:, 0], values[:, 0], 0.0))
        capacity = self.share * self.seconds - self.deciding - self.costs.base
        rungs = best_rungs(values, self.costs.each, capacity)
        return decision._replace(memory=decision.memory._replace(rungs=rungs))

    def deciding_in(self, seconds: Callable[[], float]) -> Rule:
        """Return the rule with the measured duration of a decision, unless the rule has one already."""
        return self if np.any(self.deciding) else replace(self, deciding=seconds())


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OneStepGains(Rule):
    """Estimate for `Budget`, by Algorithm 1, what the top rung gains over the first one for every human.

    Algorithm 1 runs in every step, on a ladder of these two rungs and with costs and cooldown of zero. It estimates the
    robot's reward in the last step under the rung that was not in use. The rungs between are not estimated, as their
    prediction would take as long as a plan. Nothing is chosen.

    Attributes:
        switching: Algorithm 1; its costs, price and cooldown are not used.
    """

    switching: Quadratic

    @property
    def ladder(self) -> tuple[HumanModel, ...]:
        """Human models, cheapest first."""
        return self.switching.ladder

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Estimate the gains, which are unknown before the first step, and keep the rungs."""
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
    """Return the rungs with the highest total value whose total cost is within a capacity; of equals, the cheapest.

    Costs are the same for all humans, so the total cost depends only on how many humans have each rung. A dynamic
    programme over these counts is therefore exact for any costs. For h humans and r rungs, it keeps a table of
    (h + 1)^(r - 1) values.

    Args:
        values: value of each rung for each human; minus infinity if the rung is impossible.
        costs: cost of each rung; infinite or NaN if the rung is impossible.
        capacity: largest total cost.

    Returns:
        The rungs; the first one for every human if nothing fits.
    """
    humans, rungs = values.shape
    counts = jnp.indices((humans + 1,) * (rungs - 1))  # number of humans with each rung above the first
    counts = jnp.concatenate([humans - counts.sum(axis=0, keepdims=True), counts])
    each = jnp.asarray(costs).reshape(-1, *[1] * (rungs - 1))
    cost = jnp.where(counts == 0, 0.0, counts * each).sum(axis=0)

    def add(table: Float[jax.Array, "*counts"], human: Float[jax.Array, "rungs"]) -> tuple[jax.Array, jax.Array]:
        before = [table]
        for axis in range(rungs - 1):
            one_less = jnp.roll(table, 1, axis)  # humans had this rung before
            before.append(jnp.where(counts[1 + axis] == 0, -jnp.inf, one_less))
        options = jnp.stack(before) + human.reshape(each.shape)
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
