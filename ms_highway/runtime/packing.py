"""Pytrees of numbers as one array.

Calling a compiled function costs about a microsecond per argument, which counts where a plan takes a hundred.
"""

from math import prod
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

__all__ = ["Layout", "Packed", "pack"]


class Layout(NamedTuple):
    """What has to be known, beside its numbers, to build a pytree of arrays; hashable."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]

    def unpack(self, numbers: Float[jax.Array, "n"]) -> Any:
        """The pytree of these numbers."""
        ends = np.cumsum([prod(shape) for shape in self.shapes])
        leaves = jnp.split(numbers, ends[:-1])
        return jax.tree.unflatten(
            self.structure, [leaf.reshape(shape) for leaf, shape in zip(leaves, self.shapes, strict=True)]
        )


class Packed(NamedTuple):
    """A pytree as one array of numbers, and how to build it again."""

    numbers: Float[np.ndarray, "n"]
    layout: Layout


def pack(tree: Any) -> Packed:
    """A pytree of numbers, packed in float32; compiled functions take them over faster than JAX converts them."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(leaf, dtype=np.float32) for leaf in leaves]
    return Packed(
        np.concatenate([array.ravel() for array in arrays]),
        Layout(structure, tuple(array.shape for array in arrays)),
    )
