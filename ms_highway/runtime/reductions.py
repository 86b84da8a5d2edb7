"""Reduce a few terms by unrolled operations.

On the CPU, XLA allocates operands and results of every reduction in each call: half a microsecond, and 50 ms of
compilation. Unrolled additions of a few terms cost neither.
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
    """Reduce the values along an axis by a function of two."""
    return reduce(function, jnp.unstack(values, axis=axis))


def unrolled_sum(values: Shaped[jax.Array, "*shape"], axis: int = -1) -> jax.Array:
    """Sum the values along an axis."""
    return unrolled_reduce(jnp.add, values, axis)
