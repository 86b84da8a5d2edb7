"""Fit the network to rollouts."""

from functools import partial

import jax
import numpy as np
import optax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.experiments.values.rollouts import Rollouts, draw_prices
from ms_highway.metareasoning.learned_value import Network, advantages, network_inputs, scale

__all__ = ["fit", "new_network"]

HIDDEN = (64, 64)
BATCH = 256
RATE = 2e-3  # of learning at first; it falls to 0 by a cosine
DECAY = 1e-4


def new_network(random: np.random.Generator, inputs: int, rungs: int) -> Network:
    """Draw a network with the variance that keeps the size of tanh layers (LeCun 1998)."""
    sizes = [inputs, *HIDDEN, rungs]
    return tuple(
        ((random.normal(size=(one, other)) / np.sqrt(one)).astype(np.float32), np.zeros(other, np.float32))
        for one, other in zip(sizes[:-1], sizes[1:], strict=True)
    )


def _loss(network, inputs, prices, targets, costs):
    """Huber loss of advantages, in units of their scale; rungs without a target do not count."""
    estimates = jax.vmap(advantages, in_axes=(None, 0, 0, None))(network, inputs, prices, costs)
    size = scale(prices, costs)[:, None]
    known = jnp.isfinite(targets)
    errors = jnp.where(known, (estimates - jnp.where(known, targets, 0)) / size, 0)
    return optax.losses.huber_loss(errors).sum(axis=-1).mean()


def fit(rollouts: Rollouts, costs, prices, centre, spread, random: np.random.Generator, steps: int) -> Network:
    network = new_network(random, len(centre), len(costs))
    optimizer = optax.adamw(optax.cosine_decay_schedule(RATE, steps), weight_decay=DECAY)
    state = optimizer.init(network)
    key = jax.random.key(int(random.integers(2**31)))
    low, high = np.log(prices)

    def step(carry, key):
        network, state = carry
        one, two = jax.random.split(key)
        chosen = jax.random.choice(one, len(rollouts.descriptions), (BATCH,))
        price = jnp.exp(jax.random.uniform(two, (BATCH,), minval=low, maxval=high))
        value = (rewards[chosen] - price[:, None, None] * seconds[chosen]).max(axis=-1)
        targets = value - value[:, :1]
        inputs = (network_inputs(descriptions[chosen], price) - centre) / spread
        gradient = jax.grad(_loss)(network, inputs, price, targets, costs)
        updates, state = optimizer.update(gradient, state, network)
        return (optax.apply_updates(network, updates), state), None

    descriptions, rewards, seconds = (jnp.asarray(part, jnp.float32) for part in rollouts)
    (network, _), _ = jax.jit(lambda: jax.lax.scan(step, (network, state), jax.random.split(key, steps)))()
    return jax.tree.map(np.asarray, network)
