"""Bound the eigenvalues of a symmetric matrix from below, with exact derivatives."""

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import Scalar


@jax.custom_jvp
def floored(symmetric: Float[jax.Array, "d d"], floor: Scalar) -> Float[jax.Array, "d d"]:
    """Return a symmetric matrix with its eigenvalues below a floor set to the floor.

    Its derivative is exact also at equal eigenvalues, where those of the eigenvectors are not finite: with divided
    differences F of max(., floor), ``d floored = V (F * (V^T dA V)) V^T``.
    """
    values, vectors = jnp.linalg.eigh(symmetric)
    return (vectors * jnp.maximum(values, floor)) @ vectors.T


@floored.defjvp
def _floored_jvp(
    primals: tuple[jax.Array, jax.Array], tangents: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    (symmetric, floor), (change, of_floor) = primals, tangents
    values, vectors = jnp.linalg.eigh(symmetric)
    high = values > floor
    above, below = jnp.where(high, values, floor)[:, None], jnp.where(high, floor - 1.0, values)[None, :]
    mixed = (above - floor) / (above - below)
    one_of_two = high[:, None] ^ high[None, :]
    shares = jnp.where(one_of_two, jnp.where(high[:, None], mixed, mixed.T), high[:, None] & high[None, :])
    turned = vectors.T @ change @ vectors
    back = vectors @ (shares * turned) @ vectors.T + of_floor * (vectors * ~high) @ vectors.T
    return (vectors * jnp.maximum(values, floor)) @ vectors.T, back
