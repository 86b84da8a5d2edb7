"""Sums over a few terms, written out.

XLA makes an array of every reduction's two operands and its result each time that a compiled function is called on the
CPU: half a microsecond, and 50 ms of compilation. Additions cost nothing of that, where the terms are few.
"""

from collections.abc import Callable
from functools import reduce

import jax
from jax import numpy as jnp
from jaxtyping import Shaped

__all__ = ["unrolled_reduce", "unrolled_sum"]


def unrolled_reduce(
    function: Callable[[jax.Array, jax.Array], jax.Array], values: Shaped[jax.Array, "*shape"], axis: int = -1
) -> jax.Array:
    """``function`` applied to the values along an axis, one after the other."""
    return reduce(function, jnp.unstack(values, axis=axis))


def unrolled_sum(values: Shaped[jax.Array, "*shape"], axis: int = -1) -> jax.Array:
    """The sum along an axis."""
    return unrolled_reduce(jnp.add, values, axis)
