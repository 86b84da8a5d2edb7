"""Maximise a quadratic within a trust region, in any number of dimensions."""

from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.numerics.second_derivatives import eigenpairs
from ms_highway.runtime.arrays import Flag, Index, Matrix, Scalar, Vector

HALVINGS = 60  # of the shift's bracket at most: more than float32 resolves


class _Bracket(NamedTuple):
    """Bounds of the shift, the number of halvings, and by how much the step at their middle leaves the ball."""

    low: Scalar
    high: Scalar
    halvings: Index
    excess: Scalar

    @property
    def middle(self) -> Scalar:
        return (self.low + self.high) / 2


def trust_region_step(
    quadratic: Matrix,
    linear: Vector,
    radius: Scalar,
    tolerance: Scalar = 0.0,
) -> Vector:
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

    def at(shift: Scalar) -> Vector:
        return jnp.where(along == 0, 0.0, along / (shift + gaps))

    def excess(shift: Scalar) -> Scalar:
        return jnp.sqrt(jnp.sum(at(shift) ** 2)) - radius

    def bracket(low: Scalar, high: Scalar, halvings: Index) -> _Bracket:
        return _Bracket(low, high, halvings, excess((low + high) / 2))

    def unfinished(found: _Bracket) -> Flag:
        return (found.halvings < HALVINGS) & (jnp.abs(found.excess) > tolerance * radius)

    def halve(found: _Bracket) -> _Bracket:
        outside = found.excess > 0
        low = jnp.where(outside, found.middle, found.low)
        high = jnp.where(outside, found.high, found.middle)
        return bracket(low, high, found.halvings + 1)

    interior = (values[-1] < 0) & (excess(least) <= 0)
    first = bracket(least, jnp.sqrt(jnp.sum(along**2)) / radius, jnp.int32(0))
    found = jax.lax.while_loop(unfinished, halve, first)
    inside = at(jnp.where(interior, least, found.middle))
    hard = (values[-1] > 0) & (found.halvings == HALVINGS)
    left = radius**2 - jnp.sum(inside**2)
    rest = jnp.where(hard & (left > 1e-5 * radius**2), jnp.sqrt(jnp.maximum(left, 0.0)), 0.0)
    return vectors @ inside.at[-1].add(jnp.where(along[-1] < 0, -rest, rest))
