"""Fit networks that estimate the value of computation to rollouts."""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import numpy as np
import optax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.experiments.values.rollouts import Rollouts, draw_prices
from ms_highway.metareasoning.learned_value import Network, advantages, network_inputs, scale

__all__ = ["BATCH", "NETWORKS", "SOFTENING", "descend", "fit", "new_network"]

NETWORKS = 4  # that differ in their first weights and in the order of the rollouts
HIDDEN = (32, 32)
STEPS = 6000
BATCH = 256
RATE = 3e-3  # of learning at first; it falls to 0 by a cosine
SOFTENING = 1.0  # power of the noise that an error weighs more with than its likelihood says (Seitzer et al. 2022)
DECAY = 0.5  # of weights, times the rate and per step
LARGEST_TARGET = 30.0  # in units of the scale of advantages: not even a crash counts more


def new_network(random: np.random.Generator, inputs: int, rungs: int) -> Network:
    """Draw weights with the variance that keeps the size of what tanh layers pass on (LeCun et al. 1998)."""
    sizes = [inputs, *HIDDEN, 2 * rungs]
    return tuple(
        (
            (random.normal(size=(NETWORKS, one, other)) / np.sqrt(one)).astype(np.float32),
            np.zeros((NETWORKS, other), np.float32),
        )
        for one, other in pairwise(sizes)
    )


def fit(
    rollouts: Rollouts,
    costs: Float[np.ndarray, "rungs"],
    prices: tuple[float, float],
    centre: Float[np.ndarray, "inputs"],
    spread: Float[np.ndarray, "inputs"],
    random: np.random.Generator,
) -> Network:
    """Fit advantages and their spread at prices drawn anew in every step, by AdamW and the likelihood of normal errors.

    What a rollout earned and planned is known for each way to go on, so that its best way at any price is known, too.
    Where small causes have large effects (Stay Back in 20 gradient steps), the spread is large, and errors weigh less.

    Args:
        rollouts: from many states.
        costs: T(M) of each rung [s].
        prices: the least and the largest lambda.
        centre: of the inputs, means by which they are standardised.
        spread: of the inputs, standard deviations likewise.
        random: draws first weights, rollouts and prices.
    """
    network = new_network(random, len(centre), len(costs))
    chosen = random.integers(len(rollouts.descriptions), size=(STEPS, NETWORKS, BATCH))
    drawn = draw_prices(random, prices, chosen.size).reshape(chosen.shape)
    numbers = (costs.astype(np.float32), centre, spread)
    single = Rollouts(*(np.asarray(part, np.float32) for part in rollouts))
    return jax.tree.map(np.asarray, _fit(network, single, numbers, chosen, drawn))


@jax.jit
def _fit(
    network: Network,
    rollouts: Rollouts,
    numbers: tuple[jax.Array, ...],
    chosen: Int[jax.Array, "steps networks batch"],
    drawn: Float[jax.Array, "steps networks batch"],
) -> Network:
    costs, centre, spread = numbers

    def loss(
        network: Network, chosen: Int[jax.Array, "networks batch"], price: Float[jax.Array, "networks batch"]
    ) -> Float[jax.Array, ""]:
        picked = Rollouts(*(part[chosen] for part in rollouts))
        earned = jnp.asarray(picked.best(price))
        size = scale(price, costs[-1] - costs[0])[..., None]
        known = jnp.isfinite(earned)
        top = known.shape[-1] - 1 - jnp.argmax(known[..., ::-1], axis=-1)[..., None]  # of the course's own ladder
        targets = (earned - jnp.take_along_axis(earned, top, axis=-1)) / size
        targets = jnp.clip(jnp.where(known, targets, 0), -LARGEST_TARGET, LARGEST_TARGET)
        inputs = (network_inputs(jnp.asarray(picked.descriptions), price) - centre) / spread
        over_top, noise = jax.vmap(partial(_one, costs))(network, inputs, price)
        errors = (over_top - jnp.take_along_axis(over_top, top, axis=-1)) / size - targets
        surprise = errors**2 / (2 * (noise / size) ** 2) + jnp.log(noise / size)
        surprise *= jax.lax.stop_gradient(noise / size) ** SOFTENING
        below_top = known & (jnp.arange(known.shape[-1]) < top)
        return jnp.where(below_top, surprise, 0).sum(axis=-1).mean(axis=-1).sum()

    return descend(loss, network, (chosen, drawn))


def descend(loss: Callable[..., Float[jax.Array, ""]], network: Network, batches: Any) -> Network:
    """Return a network after steps of AdamW, whose rate falls to 0 by a cosine.

    Args:
        loss: of a network and of what a batch consists of.
        network: first weights.
        batches: tuple of arrays [steps, ...].
    """
    optimizer = optax.adamw(optax.cosine_decay_schedule(RATE, len(batches[0])), weight_decay=DECAY)

    def step(
        carry: tuple[Network, optax.OptState], batch: tuple[jax.Array, ...]
    ) -> tuple[tuple[Network, optax.OptState], None]:
        network, state = carry
        updates, state = optimizer.update(jax.grad(loss)(network, *batch), state, network)
        return (optax.apply_updates(network, updates), state), None

    (network, _), _ = jax.lax.scan(step, (network, optimizer.init(network)), batches)
    return network


def _one(
    costs: Float[jax.Array, "rungs"],
    network: Network,
    inputs: Float[jax.Array, "batch inputs"],
    prices: Float[jax.Array, "batch"],
) -> tuple[Float[jax.Array, "batch rungs"], Float[jax.Array, "batch rungs"]]:
    """Estimate a batch by one of the networks."""
    alone = jax.tree.map(lambda part: part[None], network)

    def estimate(inputs: Float[jax.Array, "inputs"], price: Float[jax.Array, ""]) -> tuple[jax.Array, jax.Array]:
        over_top, noise = advantages(alone, inputs, price, costs, costs[-1] - costs[0])
        return over_top[0], noise[0]

    return jax.vmap(estimate)(inputs, prices)
