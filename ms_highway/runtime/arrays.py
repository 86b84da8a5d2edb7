"""Name arrays by their shapes; all but `SameArray` may be of NumPy or of JAX, which a type checker cannot tell."""

from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

Array: TypeAlias = Any
SameArray = TypeVar("SameArray", jax.Array, np.ndarray)
"""An array of either kind, returned in the same kind."""

Scalar: TypeAlias = Float[Any, ""]
Index: TypeAlias = Int[Any, ""]
Flag: TypeAlias = Bool[Any, ""]
Vector: TypeAlias = Float[Any, "n"]
Matrix: TypeAlias = Float[Any, "n n"]
Numbers: TypeAlias = Float[Any, "*shape"]
