"""Name arrays by their shapes, and loop over rows.

All types except `SameArray` may be of NumPy or JAX, which a type checker cannot tell apart.
"""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
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

Control: TypeAlias = Float[Any, "2"]
Controls: TypeAlias = Float[Any, "steps 2"]
ManyControls: TypeAlias = Float[Any, "*batch steps 2"]
Trajectory: TypeAlias = Float[Any, "fields steps"]
"""Motion of one car over the steps of a plan, the fields of its `ms_highway.game.dynamics.Motion` stacked."""

Car: TypeAlias = Float[Any, "4"]  # x, y [m], heading [rad], speed [m/s]
State: TypeAlias = Float[Any, "cars 4"]  # robot, humans, scripted cars
HumansControl: TypeAlias = Float[Any, "humans 2"]  # omega, acceleration
HumansControls: TypeAlias = Float[Any, "humans steps 2"]
Trajectories: TypeAlias = Float[Any, "cars fields steps"]
Times: TypeAlias = Float[Any, "*times"]

Weights: TypeAlias = Float[Any, "features"]
HumansWeights: TypeAlias = Float[Any, "humans features"]
Rungs: TypeAlias = Int[Any, "humans"]  # the place on the ladder of every human's model
Gains: TypeAlias = Float[Any, "humans rungs"]
Belief: TypeAlias = Float[Any, "humans models"]
PerHuman: TypeAlias = Float[Any, "humans"]


def for_rows(function: Callable[..., Any], *arrays: Any) -> Any:
    """Compute a function of every row of pytrees of arrays; a single row needs no `jax.vmap`, so it compiles faster."""
    if len(jax.tree.leaves(arrays)[0]) > 1:
        return jax.vmap(function)(*arrays)
    return jax.tree.map(lambda part: part[None], function(*jax.tree.map(lambda part: part[0], arrays)))


def for_each(chosen: Bool[Any, "n"], function: Callable[[Index, Any], Any], start: Any) -> Any:
    """Loop over the chosen rows, one round for each, so that the time is proportional to their number.

    Where no row is chosen, nothing is computed: without the condition, XLA would compute before the loop whatever is
    the same in all rounds.

    Args:
        chosen: rows to loop over.
        function: takes the number of a row and the result so far, and returns the next result.
        start: first result.
    """

    def loop() -> Any:
        order = jnp.argsort(~chosen, stable=True)
        return jax.lax.fori_loop(0, jnp.sum(chosen), lambda place, found: function(order[place], found), start)

    return jax.lax.cond(chosen.any(), loop, lambda: start)
