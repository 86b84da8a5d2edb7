"""Draw random numbers by NumPy, or by JAX within a function that it traces."""

from typing import Any, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp


def _shape(size: Any) -> list[int]:
    return np.atleast_1d(size).astype(int).tolist()


class TracedRandom:
    """Draw by JAX what NumPy's generator draws, from a key; the same methods, as far as they are used here."""

    def __init__(self, key: jax.Array) -> None:
        self._key = key

    def _next(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key

    def normal(self, loc: Any = 0.0, scale: Any = 1.0, size: Any = ()) -> jax.Array:
        """Draw from a normal distribution."""
        return loc + jnp.asarray(scale) * jax.random.normal(self._next(), _shape(size))

    def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = ()) -> jax.Array:
        """Draw from a uniform distribution."""
        return jax.random.uniform(self._next(), _shape(size), minval=low, maxval=high)

    def beta(self, a: float, b: float, size: Any = ()) -> jax.Array:
        """Draw from a beta distribution."""
        return jax.random.beta(self._next(), a, b, _shape(size))


Random: TypeAlias = np.random.Generator | TracedRandom


def namespace(random: Random) -> Any:
    """Return the module, NumPy or JAX's, that computes with what is drawn."""
    return jnp if isinstance(random, TracedRandom) else np
