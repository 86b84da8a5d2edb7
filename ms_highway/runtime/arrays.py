"""Types of arrays of JAX and NumPy, and reductions of a few terms.

On the CPU, XLA allocates operands and results of every reduction in each call: half a microsecond, and 50 ms of
compilation. Unrolled additions of a few terms cost neither.
"""

from collections.abc import Callable
from functools import reduce
from typing import TypeAlias, TypeVar

import jax
import numpy as np
from jax import numpy as jnp

Array: TypeAlias = jax.Array | np.ndarray
SameArray = TypeVar("SameArray", jax.Array, np.ndarray)
"""An array of either kind, returned in the same kind."""


def unrolled_reduce(
    function: Callable[[jax.Array, jax.Array], jax.Array], values: jax.Array, axis: int = -1
) -> jax.Array:
    """Reduce the values along an axis by a function of two."""
    return reduce(function, jnp.unstack(values, axis=axis))


def unrolled_sum(values: jax.Array, axis: int = -1) -> jax.Array:
    """Sum the values along an axis."""
    return unrolled_reduce(jnp.add, values, axis)
