"""Compile functions, quickly or into one kernel, and call them with few arguments, or for many items."""

from collections.abc import Callable, Hashable
from functools import cache, wraps
from math import prod
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.runtime.jax_settings import single_precision


@cache
def quick_options() -> dict[str, bool]:
    """Return compiler options that halve compilation time, where XLA knows them (JAX up to 0.11.0); starts JAX.

    They make small plans a tenth slower, and large ones not.
    """
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return {}
    return options


def in_one_kernel(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """Wrap a function of float arrays, the first of which begins with a finite number, in a loop that runs once.

    With `ms_highway.runtime.jax_settings.low_latency`, XLA compiles it as one kernel; without, the loop does no harm.
    XLA must not find out that it runs once or that its inputs stay the same, or it would remove it. Returns NaN where
    the first number is NaN.
    """

    @wraps(function)
    def looped(*arguments: jax.Array) -> jax.Array:
        shape = jax.eval_shape(function, *arguments)

        def run(carry: tuple[jax.Array, tuple[jax.Array, ...], jax.Array]) -> tuple[Any, ...]:
            _, given, _ = carry
            return jnp.bool(True), tuple(jnp.zeros_like(argument) for argument in given), function(*given)

        first = jnp.isnan(arguments[0].ravel()[0]), arguments, jnp.full(shape.shape, jnp.nan, shape.dtype)
        return jax.lax.while_loop(lambda carry: ~carry[0], run, first)[-1]

    return looped


def jit_quickly(function: Callable[..., Any], **options: Hashable) -> Callable[..., Any]:
    """Apply `jax.jit` with `quick_options` and further compiler options; compute in single precision.

    XLA is asked at the first call, so that importing a module does not start JAX. There is a function of JAX for every
    structure of arguments, named in full: JAX takes dataclasses of other types with the same fields for equal, and now
    and then computes with what it compiled for another one.
    """

    @cache
    def compiled(structure: str) -> jax.stages.Wrapped:
        named = wraps(function)(lambda *arguments: function(*arguments))  # JAX remembers by function
        return jax.jit(named, compiler_options={**quick_options(), **options})

    @wraps(function)
    def computed(*arguments: Any) -> Any:
        with single_precision():
            return compiled(str(jax.tree.structure(arguments)))(*arguments)

    return computed


BATCH = 32  # items; more are hardly faster and waste more on the last batch


def in_batches(function: Callable[[Any], Any], items: Any) -> Any:
    """Compute a function of all items; return NumPy arrays.

    The last batch is padded with copies of the last item, so that the function is compiled once for any n but 1: a
    single item is computed alone, as it is often awaited.

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


class Layout(NamedTuple):
    """Structure and shapes of a pytree of arrays; hashable."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]

    def unpack(self, numbers: jax.Array) -> Any:
        """Build the pytree of these numbers [n]."""
        ends = np.cumsum([prod(shape) for shape in self.shapes])
        return jax.tree.unflatten(self.structure, map(jnp.reshape, jnp.split(numbers, ends[:-1]), self.shapes))


class Packed(NamedTuple):
    """A pytree as one array of numbers [n], and its layout."""

    numbers: np.ndarray
    layout: Layout


def pack(tree: Any) -> Packed:
    """Pack a pytree of numbers in float32 with NumPy, which is faster than a conversion by JAX."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(leaf, dtype=np.float32) for leaf in leaves]
    layout = Layout(structure, tuple(array.shape for array in arrays))
    return Packed(np.concatenate([array.ravel() for array in arrays]), layout)
