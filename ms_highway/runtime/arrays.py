"""Names of arrays that JAX and NumPy both have a form of."""

from typing import TypeAlias, TypeVar

import jax
import numpy as np

__all__ = ["Array", "SameArray"]

Array: TypeAlias = jax.Array | np.ndarray
SameArray = TypeVar("SameArray", jax.Array, np.ndarray)
"""An array that a function takes of either kind, and returns of the same."""
