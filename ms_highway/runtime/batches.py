"""Many like items through one compiled function, a batch at a time."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

__all__ = ["BATCH", "in_batches"]

BATCH = 32  # items; more are hardly faster, and fewer are computed in vain


def in_batches(function: Callable[[Any], Any], items: Any) -> Any:
    """What a function makes of all items, in NumPy arrays.

    The last batch is filled up with copies of the last item, so that a compiled function is compiled once, however many
    items there are.

    Args:
        function: of a pytree of arrays [BATCH, ...], to a pytree of arrays [BATCH, ...].
        items: a pytree of arrays [n, ...]; floating-point numbers are passed on in single precision.
    """
    items = jax.tree.map(_single, items)
    number, results = len(jax.tree.leaves(items)[0]), []
    for first in range(0, number, BATCH):
        places = np.minimum(np.arange(first, first + BATCH), number - 1)
        result = function(jax.tree.map(lambda array, places=places: array[places], items))
        results.append(jax.tree.map(np.asarray, result))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:number], *results)


def _single(array: Any) -> np.ndarray:
    array = np.asarray(array)
    return array.astype(np.float32) if np.issubdtype(array.dtype, np.floating) else array
