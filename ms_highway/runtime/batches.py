"""Compute a compiled function of many items in batches of one size."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

__all__ = ["BATCH", "in_batches"]

BATCH = 32  # items; more are hardly faster and waste more on the last batch


def in_batches(function: Callable[[Any], Any], items: Any) -> Any:
    """Compute a function of all items; return NumPy arrays.

    The last batch is padded with copies of the last item, so that the function is compiled once for any n.

    Args:
        function: from a pytree of arrays [BATCH, ...] to a pytree of arrays [BATCH, ...].
        items: pytree of arrays [n, ...]; floating-point numbers are converted to single precision.
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
