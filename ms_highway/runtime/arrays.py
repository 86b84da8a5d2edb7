"""Name the types of arrays of JAX and NumPy."""

from typing import TypeAlias, TypeVar

import jax
import numpy as np

__all__ = ["Array", "SameArray"]

Array: TypeAlias = jax.Array | np.ndarray
SameArray = TypeVar("SameArray", jax.Array, np.ndarray)
"""An array of either kind, returned in the same kind."""
