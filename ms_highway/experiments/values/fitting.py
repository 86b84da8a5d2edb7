"""Fit networks that estimate the value of computation to rollouts."""

from functools import partial
from itertools import pairwise
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.experiments.values.rollouts import Random, Rollouts, draw_prices
from ms_highway.metareasoning.learned_value import Network, network_inputs, noise, outputs, scale
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.extras import needing

with needing("learning"):
    import optax

NETWORKS = 4  # that differ in their first weights and in the order of the rollouts
HIDDEN = (32, 32)
STEPS = 3000, 6000  # over the cheapest, over the top
BATCH = 256
RATE = 3e-3  # of learning at first; it falls to 0 by a cosine
SOFTENING = 1.0  # power of the noise that an error weighs more with than its likelihood says (Seitzer et al. 2022)
DECAY = 0.5  # of weights, times the rate and per step
LARGEST_TARGET = 30.0  # in units of the scale of advantages: not even a crash counts more


def new_network(random: Random, inputs: int, means: int) -> Network:
    """Draw weights with the variance that keeps the size of what tanh layers pass on (LeCun et al. 1998)."""
    return tuple(
        (
            (random.normal(size=(NETWORKS, one, other)) / np.sqrt(one)).astype(np.float32),
            np.zeros((NETWORKS, other), np.float32),
        )
        for one, other in pairwise([inputs, *HIDDEN, 2 * means])
    )


def fit(
    network: Network,
    rollouts: Rollouts,
    costs: Array,
    prices: tuple[float, float] | None,
    centre: Array,
    spread: Array,
    random: Random,
) -> Network:
    """Fit what rungs are worth, and its spread, by AdamW and the likelihood of normal errors.

    Where small causes have large effects (Stay Back in 20 gradient steps), the spread is large, and errors weigh less.

    Args:
        network: first weights.
        rollouts: from many states.
        costs: T(M) of each rung [s].
        prices: the least and the largest lambda, for advantages over the top at prices drawn anew in every step: what a
            rollout earned and planned is known for each way to go on, so that its best way at any price is known, too.
            Without, gains over the cheapest rung are fitted.
        centre: of the inputs, means by which they are standardised.
        spread: of the inputs, standard deviations likewise.
        random: draws rollouts and prices.
    """
    over_top = prices is not None
    shape = STEPS[over_top], NETWORKS, BATCH
    chosen = random.integers(len(rollouts.descriptions), size=shape)
    drawn = np.zeros(shape) if prices is None else draw_prices(random, prices, chosen.size).reshape(shape)
    numbers = jax.tree.map(np.float32, (rollouts, costs, centre, spread, drawn))
    return jax.tree.map(np.asarray, _fit(over_top, network, chosen, *numbers))


def _over_the_top(means: Array, rollouts: Rollouts, costs: Array, prices: Array) -> tuple[Array, Array]:
    """Return the errors of advantages in units of `scale`, and where they count."""
    earned, size = jnp.asarray(rollouts.best(prices)), scale(prices, costs[-1] - costs[0])[..., None]
    known = jnp.isfinite(earned)
    top = known.shape[-1] - 1 - jnp.argmax(known[..., ::-1], axis=-1)[..., None]  # of the course's own ladder
    over_top = partial(jnp.take_along_axis, indices=top, axis=-1)
    targets = jnp.clip(jnp.where(known, (earned - over_top(earned)) / size, 0), -LARGEST_TARGET, LARGEST_TARGET)
    estimates = size * (means - means[..., -1:]) - prices[..., None] * (costs - costs[-1])
    return (estimates - over_top(estimates)) / size - targets, known & (jnp.arange(known.shape[-1]) < top)


@partial(jax.jit, static_argnums=0)
def _fit(
    over_top: bool,
    network: Network,
    chosen: Array,
    rollouts: Rollouts,
    costs: Array,
    centre: Array,
    spread: Array,
    prices: Array,
) -> Network:

    def one(network: Network, inputs: Array) -> tuple[Array, Array]:
        means, spreads = outputs(jax.tree.map(lambda part: part[None], network), inputs)
        return means[0], noise(spreads[0])

    def loss(network: Network, chosen: Array, prices: Array) -> Array:
        picked = Rollouts(*(part[chosen] for part in rollouts))
        described = jnp.asarray(picked.descriptions)
        inputs = network_inputs(described, prices) if over_top else described
        means, apart = jax.vmap(jax.vmap(one, in_axes=(None, 0)))(network, (inputs - centre) / spread)
        if over_top:
            errors, counts = _over_the_top(means, picked, costs, prices)
        else:
            gains = picked.rewards[..., 1:, 0]
            counts = jnp.isfinite(gains)
            errors = means - jnp.where(counts, gains, 0)
        surprise = errors**2 / (2 * apart**2) + jnp.log(apart)
        surprise *= jax.lax.stop_gradient(apart) ** SOFTENING
        return jnp.where(counts, surprise, 0).sum(axis=-1).mean(axis=-1).sum()

    optimizer = optax.adamw(optax.cosine_decay_schedule(RATE, len(chosen)), weight_decay=DECAY)

    def step(carry: Any, batch: tuple[Array, Array]) -> tuple[Any, None]:
        network, state = carry
        updates, state = optimizer.update(jax.grad(loss)(network, *batch), state, network)
        return (optax.apply_updates(network, updates), state), None

    (network, _), _ = jax.lax.scan(step, (network, optimizer.init(network)), (chosen, prices))
    return network
