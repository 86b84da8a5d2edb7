"""Compile functions quickly, and compute them for many items."""

from collections.abc import Callable, Hashable, Mapping
from functools import cache, update_wrapper, wraps
from typing import Any

import jax
import numpy as np

from ms_highway.runtime.jax_settings import single_precision


@cache
def quick_options() -> dict[str, bool]:
    """Return compiler options that halve compilation time, if XLA knows them (JAX up to 0.11.0); this starts JAX.

    They make small plans slower by a tenth, but not large ones.
    """
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return {}
    return options


class Compiled:
    """A function that is compiled at its first call with each structure of arguments, see `jit_quickly`."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, Hashable]) -> None:
        self._function, self._options, self._compiled = function, options, dict[str, jax.stages.Wrapped]()
        update_wrapper(self, function)

    def of(self, *arguments: Any) -> jax.stages.Wrapped:
        """Return the jitted function for arguments of this structure."""
        structure = str(jax.tree.structure(arguments))
        if structure not in self._compiled:
            named = wraps(self._function)(lambda *arguments: self._function(*arguments))  # JAX caches by function
            self._compiled[structure] = jax.jit(named, compiler_options={**quick_options(), **self._options})
        return self._compiled[structure]

    def __call__(self, *arguments: Any) -> Any:
        """Compute in single precision."""
        with single_precision():
            return self.of(*arguments)(*arguments)


def jit_quickly(function: Callable[..., Any], **options: Hashable) -> Compiled:
    """Apply `jax.jit` with `quick_options` and further compiler options; compute in single precision.

    XLA is asked for its options at the first call, so that importing a module does not start JAX. Every structure of
    arguments, with the types of its dataclasses, has its own jitted function: JAX may take dataclasses of other types
    with the same fields for equal, and then uses what it compiled for another type.
    """
    return Compiled(function, options)


class Placed:
    """Numbers that a computation takes, put on JAX's device from the second time on.

    Putting them there takes longer than passing them once.
    """

    def __init__(self, tree: Any) -> None:
        self.tree, self._taken = tree, 0

    def take(self) -> Any:
        """Return the numbers for one computation."""
        self._taken += 1
        if self._taken == 2:
            with single_precision():
                self.tree = jax.device_put(self.tree)
        return self.tree


def single(tree: Any) -> Any:
    """Return a tree of numbers as NumPy arrays in single precision, for which a function is compiled once."""
    return jax.tree.map(lambda number: np.asarray(number, np.float32), tree)


BATCH = 32  # items; larger batches are hardly faster and waste more on the last one


def in_batches(function: Callable[[Any], Any], items: Any) -> Any:
    """Compute a function of all items; return NumPy arrays.

    The last batch is padded with copies of the last item, so that the function is compiled once for all n > 1. A single
    item is computed alone, as users often wait for it.

    Args:
        function: from a pytree of arrays [BATCH, ...] to a pytree of arrays [BATCH, ...], and of [1, ...].
        items: pytree of arrays [n, ...].
    """
    number = len(jax.tree.leaves(items)[0])
    if number == 1:
        return jax.tree.map(np.asarray, function(items))
    results = []
    for first in range(0, number, BATCH):
        batch = jax.tree.map(
            lambda array, places=range(first, first + BATCH): np.take(array, places, axis=0, mode="clip"), items
        )
        results.append(function(batch))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:number], *results)
