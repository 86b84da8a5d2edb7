"""Maximise a quadratic within a trust region, in any number of dimensions."""

from typing import TypeAlias

import jax
from jax import numpy as jnp

from ms_highway.runtime.arrays import Flag, Index, Matrix, Scalar, Vector

HALVINGS = 60  # of the shift's bracket at most, beyond what float32 resolves

Bracket: TypeAlias = tuple[Scalar, Scalar, Index]
"""Bounds of the shift, and the number of halvings."""


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
    values, vectors = jnp.linalg.eigh(quadratic)
    along = vectors.T @ linear
    gaps = values[-1] - values
    least = jnp.maximum(0.0, -values[-1])

    def at(shift: Scalar) -> Vector:
        return jnp.where(along == 0, 0.0, along / (shift + gaps))

    def excess(shift: Scalar) -> Scalar:
        return jnp.sqrt(jnp.sum(at(shift) ** 2)) - radius

    def unfinished(bracket: Bracket) -> Flag:
        low, high, halvings = bracket
        return (halvings < HALVINGS) & (jnp.abs(excess((low + high) / 2)) > tolerance * radius)

    def halve(bracket: Bracket) -> Bracket:
        low, high, halvings = bracket
        middle = (low + high) / 2
        outside = excess(middle) > 0
        return jnp.where(outside, middle, low), jnp.where(outside, high, middle), halvings + 1

    interior = (values[-1] < 0) & (excess(least) <= 0)
    first = least, jnp.sqrt(jnp.sum(along**2)) / radius, jnp.int32(0)
    low, high, halvings = jax.lax.while_loop(unfinished, halve, first)
    inside = at(jnp.where(interior, least, (low + high) / 2))
    hard = (values[-1] > 0) & (halvings == HALVINGS)
    left = radius**2 - jnp.sum(inside**2)
    rest = jnp.where(hard & (left > 1e-5 * radius**2), jnp.sqrt(jnp.maximum(left, 0.0)), 0.0)
    return vectors @ inside.at[-1].add(jnp.where(along[-1] < 0, -rest, rest))
