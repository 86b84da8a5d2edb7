"""Time compiled functions: warm, and until the result is there."""

from collections.abc import Callable, Hashable
from time import perf_counter
from typing import Any

import jax
import numpy as np

__all__ = ["forget", "timed", "warm_up"]

_warm: set[Hashable] = set()  # compiled functions that have run with arguments of these shapes


def warm_up(function: Callable[..., Any], *arguments: Any) -> float:
    """Compile and run once what has not run before; seconds spent, 0 if it was warm already."""
    leaves, structure = jax.tree.flatten(arguments)
    key = (function, structure, tuple(np.shape(leaf) for leaf in leaves))
    if key in _warm:
        return 0.0
    start = perf_counter()
    jax.block_until_ready(function(*arguments))
    _warm.add(key)
    return perf_counter() - start


def forget() -> None:
    """Forget all that this process has compiled."""
    jax.clear_caches()
    _warm.clear()


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Result of a warm computation, and the seconds it took until the result was there."""
    start = perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, perf_counter() - start
