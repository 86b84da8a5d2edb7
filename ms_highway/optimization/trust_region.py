"""Maximise a quadratic within a trust region, in any number of dimensions."""

from typing import NamedTuple

import jax
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.optimization.second_derivatives import eigenpairs
from ms_highway.runtime.arrays import Array, unrolled_sum

__all__ = ["trust_region_step"]

HALVINGS = 60  # of the shift's bracket at most: more than float32 resolves


class _Bracket(NamedTuple):
    """Bounds of the shift, the number of halvings, and by how much the step at their middle leaves the ball."""

    low: Float[jax.Array, ""]
    high: Float[jax.Array, ""]
    halvings: Int[jax.Array, ""]
    excess: Float[jax.Array, ""]

    @property
    def middle(self) -> Float[jax.Array, ""]:
        return (self.low + self.high) / 2


def trust_region_step(
    quadratic: Float[jax.Array, "n n"],
    linear: Float[jax.Array, "n"],
    radius: float | Float[Array, ""],
    tolerance: float | Float[Array, ""] = 0.0,
) -> Float[jax.Array, "n"]:
    """Maximise ``x^T A x / 2 + b^T x`` over the ball ``|x| <= radius``.

    In A's eigenbasis, with eigenvalues l, the maximiser is ``x = b / (shift + max(l) - l)`` for the smallest
    ``shift >= max(0, -max(l))`` that keeps x in the ball (More and Sorensen 1983). The shift is at most
    ``|b| / radius`` and is bisected until ``|x|`` is within ``tolerance * radius`` of the radius. Where b has no part
    along the top eigenvector (the "hard case"), x is extended along it to the boundary.
    """
    values, vectors = eigenpairs((quadratic + quadratic.T) / 2)
    along = vectors.T @ linear
    gaps = values[-1] - values
    least = jnp.maximum(0.0, -values[-1])

    def at(shift: Float[jax.Array, ""]) -> Float[jax.Array, "n"]:
        return jnp.where(along == 0, 0.0, along / (shift + gaps))

    def excess(shift: Float[jax.Array, ""]) -> Float[jax.Array, ""]:
        return jnp.sqrt(unrolled_sum(at(shift) ** 2)) - radius

    def bracket(low: Float[jax.Array, ""], high: Float[jax.Array, ""], halvings: Int[jax.Array, ""]) -> _Bracket:
        return _Bracket(low, high, halvings, excess((low + high) / 2))

    def unfinished(found: _Bracket) -> Bool[jax.Array, ""]:
        return (found.halvings < HALVINGS) & (jnp.abs(found.excess) > tolerance * radius)

    def halve(found: _Bracket) -> _Bracket:
        outside = found.excess > 0
        low = jnp.where(outside, found.middle, found.low)
        high = jnp.where(outside, found.high, found.middle)
        return bracket(low, high, found.halvings + 1)

    interior = (values[-1] < 0) & (excess(least) <= 0)
    first = bracket(least, jnp.sqrt(unrolled_sum(along**2)) / radius, jnp.int32(0))
    found = jax.lax.while_loop(unfinished, halve, first)
    inside = at(jnp.where(interior, least, found.middle))
    hard = (values[-1] > 0) & (found.halvings == HALVINGS)
    left = radius**2 - unrolled_sum(inside**2)
    rest = jnp.where(hard & (left > 1e-5 * radius**2), jnp.sqrt(jnp.maximum(left, 0.0)), 0.0)
    return vectors @ inside.at[-1].add(jnp.where(along[-1] < 0, -rest, rest))
