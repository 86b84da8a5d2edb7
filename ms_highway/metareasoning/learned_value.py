"""Decide which human model is worth its time, by a learned value of computation.

Networks estimate the value from the situation of each human alone (Russell and Wefald 1991; Callaway et al. 2018), over
a baseline:

* ``top``: what the robot earns more over the coming steps, less lambda for the seconds of planning, if this step is
  planned with rung m rather than with the top rung: the advantage ``Q(x, m) - Q(x, top)`` of the paper's meta-MDP. The
  price is an input.
* ``cheapest``: what the robot earns more, per step, than with the first rung for this human, the others predicted as
  they are. The price of the time that the human adds to a plan is subtracted.
"""

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, TypeAlias

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.game import Game
from ms_highway.metareasoning.rule import NOT_ESTIMATED, Decision, Memory, Outcome
from ms_highway.metareasoning.situation import describe
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.runtime.arrays import Array, Index, Scalar, Vector

Network: TypeAlias = tuple[tuple[Float[Array, "networks inputs outputs"], Float[Array, "networks outputs"]], ...]
"""Weights and biases of each layer of several networks; all layers but the last are followed by tanh."""

Baseline: TypeAlias = Literal["top", "cheapest"]
Numbers: TypeAlias = Float[jax.Array, "humans numbers"]

CAUTION = 0.5  # standard deviations among the networks
NOISE_CAUTION = 0.08  # standard deviations of outcomes
LEAST_NOISE = 0.02  # in units of `scale`


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LearnedValue:
    """Take the rung of the highest estimated value for every human.

    Attributes:
        costs: planning time.
        price: lambda, reward per second of planning. With the baseline ``top``, below all prices that were learned, 0
            among them, the top of the ladder plans; above them, the first rung.
        prices: the least and the largest price that were learned.
        span: T(M) of the top less that of the cheapest rung that were learned [s], see `scale`; the ladder may be
            shorter.
        network: estimates the values from `network_inputs`.
        centre, spread: of the inputs, by which they are standardised.
        ladder: human models, cheapest first (static).
        baseline: over which rung values are estimated (static).
        cautious: whether gains are what is compared to choose, net of the price and of a margin for doubt; or else what
            is expected, as budgets need it (static).
    """

    costs: Costs
    price: Scalar
    prices: Float[Array, "2"]
    span: Scalar
    network: Network
    centre: Float[Array, "inputs"]
    spread: Float[Array, "inputs"]
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})
    baseline: Baseline = field(default="top", metadata={"static": True})
    cautious: bool = field(default=True, metadata={"static": True})
    in_one_kernel: ClassVar[bool] = True

    def look(self, game: Game, memory: Memory, outcome: Outcome) -> Numbers:
        """Describe the state after the last step."""
        return describe(game, outcome.after, surroundings=self.baseline == "cheapest")

    def choose(self, memory: Memory, seen: Numbers) -> Decision:
        """Take the rung of the highest value; see `_over_top` and `_over_cheapest`."""
        one = self._over_top if self.baseline == "top" else self._over_cheapest
        rungs = jnp.asarray(memory.rungs)
        if len(rungs) == 1:
            chosen, gains, failed = (part[None] for part in one(seen[0], rungs[0]))
        else:
            chosen, gains, failed = jax.vmap(one)(seen, rungs)
        after = memory._replace(rungs=chosen.astype(jnp.int32), step=memory.step + 1)
        return Decision(after, gains, failed.any())

    def _over_top(self, seen: Vector, rung: Index) -> tuple[Any, Any, Any]:
        """Return the best rung for a human, the gains over the one in use, and whether they could not be estimated.

        A rung counts by its mean advantage over the top less its uncertainty: `CAUTION` standard deviations among the
        networks, and `NOISE_CAUTION` standard deviations of what they saw happen. In doubt, the top rung plans. At
        prices that were not learned, nothing is compared.
        """
        price, (least, largest) = jnp.asarray(self.price), jnp.asarray(self.prices)
        bounded, top = jnp.clip(price, least, largest), len(self.ladder) - 1
        inputs = (network_inputs(seen, bounded) - self.centre) / self.spread
        costs = jnp.asarray(self.costs.each)
        each, noise = advantages(self.network, inputs, bounded, costs, jnp.asarray(self.span))
        means, apart = jnp.mean(each, axis=0), jnp.std(each, axis=0)
        cautious = means - CAUTION * apart - NOISE_CAUTION * jnp.mean(noise, axis=0).at[top].set(0.0)
        failed = ~jnp.isfinite(cautious).all()
        chosen = jnp.where(failed | (price < least), top, jnp.where(price > largest, 0, jnp.argmax(cautious)))
        compared, unknown = (cautious, failed | (price != bounded)) if self.cautious else (means, failed)
        return chosen, jnp.where(unknown, NOT_ESTIMATED, compared - compared[rung]), failed

    def _over_cheapest(self, seen: Vector, rung: Index) -> tuple[Any, Any, Any]:
        """Return the best rung for a human, the gains over the first, and whether they could not be estimated.

        A gain counts less `CAUTION` standard deviations among the networks: in doubt, the first rung predicts.
        """
        means, _ = outputs(self.network, (seen - self.centre) / self.spread)
        nothing = jnp.zeros(1)
        gains = jnp.concatenate([nothing, jnp.mean(means, axis=0)])
        doubts = jnp.concatenate([nothing, jnp.std(means, axis=0)])
        known = jnp.isfinite(gains).all()
        values = gains - CAUTION * doubts - self.price * jnp.asarray(self.costs.each)
        return jnp.where(known, jnp.argmax(values), 0), values if self.cautious else gains, ~known


def network_inputs(
    description: Float[jax.Array, "*batch numbers"], price: Float[jax.Array, "*batch"]
) -> Float[jax.Array, "*batch inputs"]:
    """Append the decimal logarithm of lambda to description of a situation."""
    return jnp.concatenate([description, jnp.log10(price)[..., None]], axis=-1)


def advantages(
    network: Network,
    inputs: Float[jax.Array, "inputs"],
    price: Scalar,
    costs: Float[jax.Array, "rungs"],
    span: Scalar,
) -> tuple[Float[jax.Array, "networks rungs"], Float[jax.Array, "networks rungs"]]:
    """Estimate the advantage of each rung over the top one, and its standard deviation, by each of the networks.

    They estimate what is earned more and what is planned later, in units of `scale`; this step's planning is known:
    ``scale(lambda) (n_m - n_top) - lambda (T_m - T_top)``.
    """
    estimates, spreads = outputs(network, inputs)
    size = scale(price, span)
    over_top = size * (estimates - estimates[:, -1:]) - price * (costs - costs[-1])
    return over_top, size * noise(spreads)


def outputs(
    network: Network, inputs: Float[jax.Array, "inputs"]
) -> tuple[Float[jax.Array, "networks means"], Float[jax.Array, "networks means"]]:
    """Return what each of the networks expects of the same inputs, and what `noise` computes its spread from."""
    *hidden, (weights, biases) = network
    inputs = jnp.broadcast_to(inputs, (len(biases), *inputs.shape))
    for layer_weights, layer_biases in hidden:
        inputs = jnp.tanh(jnp.einsum("ni,nio->no", inputs, layer_weights) + layer_biases)
    means, spreads = jnp.split(jnp.einsum("ni,nio->no", inputs, weights) + biases, 2, axis=-1)
    return means, spreads


def noise(spreads: Numbers) -> Numbers:
    """Return standard deviations of outcomes from the second half of a network's `outputs`."""
    return LEAST_NOISE + jax.nn.softplus(spreads)


def scale(price: Float[jax.Array, "*batch"], span: Scalar) -> Float[jax.Array, "*batch"]:
    """Return the size of advantages at a price, ``1 + lambda (T_top - T_0)``, in which errors are measured."""
    return 1 + price * span
