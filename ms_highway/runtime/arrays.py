"""Name arrays by their shapes; those on Any may be of NumPy or of JAX."""

from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array: TypeAlias = jax.Array | np.ndarray
SameArray = TypeVar("SameArray", jax.Array, np.ndarray)
"""An array of either kind, returned in the same kind."""

Scalar: TypeAlias = Float[Any, ""]
Number: TypeAlias = float | Scalar
Index: TypeAlias = int | Int[Any, ""]
Flag: TypeAlias = Bool[Any, ""]
Vector: TypeAlias = Float[Any, "n"]
Matrix: TypeAlias = Float[Any, "n n"]
Numbers: TypeAlias = Float[Any, "*shape"]
