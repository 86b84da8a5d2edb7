"""Choose models by a learned value of computation (Russell and Wefald 1991; Callaway et al. 2018).

From the situation of a human, networks estimate how much more the robot earns per step if a rung, instead of the
cheapest one, predicts this human, while the same rung predicts all nearer humans. The price of the time that the human
adds to a plan is subtracted. A gap may open only if two humans yield together. Therefore, the rule adds up the values
from the nearest human outwards, and predicts as many humans by more than the cheapest rung as have the highest sum.
"""

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.choice.rule import NOT_ESTIMATED, Decision, Memory, Outcome, Rule, unestimated
from ms_highway.choice.situation import describe, nearness
from ms_highway.game.game import Game
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Index, Scalar, Vector

Network: TypeAlias = tuple[tuple[Float[Array, "networks inputs outputs"], Float[Array, "networks outputs"]], ...]
"""Weights and biases of each layer of several networks; all layers but the last are followed by tanh."""

TOGETHER = 4  # largest number of humans that are predicted by more than the first rung
DOUBT_MARGIN = 0.5  # in standard deviations among the networks
MIN_NOISE = 0.02  # least standard deviation of a gain


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LearnedValue(Rule):
    """Take the rung with the highest value for the nearest humans, as many as have the highest total value.

    Attributes:
        costs: planning time of each rung.
        price: lambda, reward per second of planning.
        network: networks that estimate the gains over the first rung from `ms_highway.choice.situation.describe`.
        centre, spread: mean and standard deviation by which the inputs of the networks are standardised.
        ladder: human models, cheapest first (static).
        cautious: whether a decision tells the gains that it compares, net of the price and of a margin for doubt.
            Otherwise, it tells the expected gains over the first rung, which budgets need. If the networks then expect
            a gain below `MIN_NOISE` from the top rung, a small gain replaces it, which is larger for nearer humans, so
            that spare time goes to them (static).
    """

    costs: Costs
    price: Scalar
    network: Network
    centre: Float[Array, "inputs"]
    spread: Float[Array, "inputs"]
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    cautious: bool = field(default=True, metadata={"static": True})

    def decide(self, game: Game, memory: Memory, outcome: Outcome) -> Decision:
        """Choose by the state after the last step. A value that is not known counts as 0, that of the first rung."""
        if len(self.ladder) == 1:
            return unestimated(memory, memory.rungs)
        values, gains, failed = jax.vmap(self._values)(describe(game, outcome.after), jnp.asarray(memory.rungs))
        rank = nearness(game, outcome.after)
        worth = values[:, 1:].max(axis=1) - values[:, 0]
        count = jnp.argmax(jnp.concatenate([jnp.zeros(1), jnp.cumsum(worth[jnp.argsort(rank)][:TOGETHER])]))
        rungs = jnp.where(rank < count, 1 + values[:, 1:].argmax(axis=1), 0)
        if not self.cautious:
            top, little = gains[:, -1], MIN_NOISE * (1 - rank / game.number)
            gains = gains.at[:, -1].set(jnp.where(jnp.abs(top) < MIN_NOISE, little, top))
        return Decision(memory._replace(rungs=rungs.astype(jnp.int32)), gains, failed.any())

    def _values(self, described: Vector, rung: Index) -> tuple[Any, Any, Any]:
        """Return the values of the rungs for a human, their gains for the `Decision`, and whether they are unknown.

        The value of a rung is its gain over the first one, less its price and `DOUBT_MARGIN` standard deviations among
        the networks, so that the first rung is chosen in doubt.
        """
        means, _ = outputs(self.network, (described - self.centre) / self.spread)
        gains, doubts = (jnp.pad(part(means, axis=0), (1, 0)) for part in (jnp.mean, jnp.std))
        known = jnp.isfinite(gains).all()
        values = gains - DOUBT_MARGIN * doubts - self.price * jnp.asarray(self.costs.each)
        estimates = values - values[rung] if self.cautious else gains
        return jnp.where(known, values, 0.0), jnp.where(known, estimates, NOT_ESTIMATED), ~known


def outputs(
    network: Network, inputs: Float[jax.Array, "inputs"]
) -> tuple[Float[jax.Array, "networks means"], Float[jax.Array, "networks means"]]:
    """Return what each network expects for the same inputs, and the numbers from which `noise` computes spreads."""
    *hidden, (weights, biases) = network
    inputs = jnp.broadcast_to(inputs, (len(biases), *inputs.shape))
    for layer_weights, layer_biases in hidden:
        inputs = jnp.tanh(jnp.einsum("ni,nio->no", inputs, layer_weights) + layer_biases)
    means, spreads = jnp.split(jnp.einsum("ni,nio->no", inputs, weights) + biases, 2, axis=-1)
    return means, spreads


def noise(spreads: Float[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """Return standard deviations of outcomes from the second half of a network's `outputs`."""
    return MIN_NOISE + jax.nn.softplus(spreads)
