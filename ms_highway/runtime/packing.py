"""Pack pytrees of numbers into one array: each argument of a compiled function costs about a microsecond per call."""

from math import prod
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

__all__ = ["Layout", "Packed", "pack"]


class Layout(NamedTuple):
    """Structure and shapes of a pytree of arrays; hashable."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]

    def unpack(self, numbers: Float[jax.Array, "n"]) -> Any:
        """Build the pytree of these numbers."""
        ends = np.cumsum([prod(shape) for shape in self.shapes])
        leaves = jnp.split(numbers, ends[:-1])
        return jax.tree.unflatten(
            self.structure, [leaf.reshape(shape) for leaf, shape in zip(leaves, self.shapes, strict=True)]
        )


class Packed(NamedTuple):
    """A pytree as one array of numbers, and its layout."""

    numbers: Float[np.ndarray, "n"]
    layout: Layout


def pack(tree: Any) -> Packed:
    """Pack a pytree of numbers in float32 with NumPy, which is faster than a conversion by JAX."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(leaf, dtype=np.float32) for leaf in leaves]
    return Packed(
        np.concatenate([array.ravel() for array in arrays]),
        Layout(structure, tuple(array.shape for array in arrays)),
    )
