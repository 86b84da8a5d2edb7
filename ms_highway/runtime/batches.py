"""Compute a compiled function of many items in batches of one size."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

BATCH = 32  # items; more are hardly faster and waste more on the last batch


def in_batches(function: Callable[[Any], Any], items: Any) -> Any:
    """Compute a function of all items; return NumPy arrays.

    The last batch is padded with copies of the last item, so that the function is compiled once for any n.

    Args:
        function: from a pytree of arrays [BATCH, ...] to a pytree of arrays [BATCH, ...].
        items: pytree of arrays [n, ...].
    """
    number = len(jax.tree.leaves(items)[0])
    results = []
    for first in range(0, number, BATCH):
        batch = jax.tree.map(
            lambda array, places=range(first, first + BATCH): np.take(array, places, axis=0, mode="clip"), items
        )
        results.append(function(batch))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:number], *results)
