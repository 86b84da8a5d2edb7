"""Solve a multiple-choice knapsack: one rung for every human, most value, within a capacity; exactly."""

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.arrays import Gains, Rungs
from ms_highway.runtime.arrays import Array, Index, Scalar


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
