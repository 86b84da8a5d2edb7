"""Time compiled functions: warm, and until the result is ready."""

from collections.abc import Callable, Hashable
from time import perf_counter
from typing import Any

import jax
import numpy as np

from ms_highway.runtime.jax_settings import single_precision

_warm: set[Hashable] = set()  # compiled functions that have run, with the shapes of their arguments


def warm_up(function: Callable[..., Any], *arguments: Any) -> float:
    """Compile and run a function that has not run before; return the seconds spent, 0 if it was warm."""
    leaves, structure = jax.tree.flatten(arguments)
    key = (function, structure, tuple(np.shape(leaf) for leaf in leaves))
    if key in _warm:
        return 0.0
    start = perf_counter()
    with single_precision():
        jax.block_until_ready(function(*arguments))
    _warm.add(key)
    return perf_counter() - start


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return the result of a warm computation, and the seconds until it was ready."""
    start = perf_counter()
    with single_precision():
        result = jax.block_until_ready(function(*arguments))
    return result, perf_counter() - start
