"""Pack pytrees of numbers into one array: each argument of a compiled function costs about a microsecond per call."""

from math import prod
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp


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
