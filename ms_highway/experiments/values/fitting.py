"""Fit networks that estimate the value of computation to rollouts."""

from itertools import pairwise
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.learned_value import Network, noise, outputs
from ms_highway.experiments.values.rollouts import Random, Rollouts
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.extras import needing

with needing("learning"):
    import optax

NETWORKS = 4  # that differ in their first weights and in the order of the rollouts
HIDDEN = (32, 32)
STEPS = 3000
BATCH = 256
RATE = 3e-3  # of learning at first; it falls to 0 by a cosine
SOFTENING = 1.0  # power of the noise that an error weighs more with than its likelihood says (Seitzer et al. 2022)
DECAY = 0.5  # of weights, times the rate and per step


def new_network(random: Random, inputs: int, means: int) -> Network:
    """Draw weights with the variance that keeps the size of what tanh layers pass on (LeCun et al. 1998)."""
    return tuple(
        (
            (random.normal(size=(NETWORKS, one, other)) / np.sqrt(one)).astype(np.float32),
            np.zeros((NETWORKS, other), np.float32),
        )
        for one, other in pairwise([inputs, *HIDDEN, 2 * means])
    )


def fit(network: Network, rollouts: Rollouts, centre: Array, spread: Array, random: Random) -> Network:
    """Fit what rungs gain over the first one, and the spread of that, by AdamW and the likelihood of normal errors.

    Where small causes have large effects (Stay Back in 20 gradient steps), the spread is large, and errors weigh less.

    Args:
        network: first weights.
        rollouts: from many states.
        centre: of the inputs, means by which they are standardised.
        spread: of the inputs, standard deviations likewise.
        random: draws rollouts.
    """
    chosen = random.integers(len(rollouts.descriptions), size=(STEPS, NETWORKS, BATCH))
    standard = (rollouts.descriptions - centre) / spread
    return jax.tree.map(np.asarray, _fit(network, chosen, np.float32(standard), np.float32(rollouts.gains)))


@jax.jit
def _fit(network: Network, chosen: Array, inputs: Array, gains: Array) -> Network:
    def one(network: Network, inputs: Array) -> tuple[Array, Array]:
        means, spreads = outputs(jax.tree.map(lambda part: part[None], network), inputs)
        return means[0], noise(spreads[0])

    def loss(network: Network, chosen: Array) -> Array:
        means, apart = jax.vmap(jax.vmap(one, in_axes=(None, 0)))(network, inputs[chosen])
        counts = jnp.isfinite(gains[chosen])
        errors = means - jnp.where(counts, gains[chosen], 0)
        surprise = errors**2 / (2 * apart**2) + jnp.log(apart)
        surprise *= jax.lax.stop_gradient(apart) ** SOFTENING
        return jnp.where(counts, surprise, 0).sum(axis=-1).mean(axis=-1).sum()

    optimizer = optax.adamw(optax.cosine_decay_schedule(RATE, len(chosen)), weight_decay=DECAY)

    def step(carry: Any, chosen: Array) -> tuple[Any, None]:
        network, state = carry
        updates, state = optimizer.update(jax.grad(loss)(network, chosen), state, network)
        return (optax.apply_updates(network, updates), state), None

    (network, _), _ = jax.lax.scan(step, (network, optimizer.init(network)), chosen)
    return network
