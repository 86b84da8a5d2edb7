"""Name arrays of controls and of what moves under them by their shapes; all may be of NumPy or of JAX."""

from typing import Any, TypeAlias

from jaxtyping import Float

Control: TypeAlias = Float[Any, "2"]
Controls: TypeAlias = Float[Any, "steps 2"]
ManyControls: TypeAlias = Float[Any, "*batch steps 2"]
Trajectory: TypeAlias = Float[Any, "fields steps"]
"""Motion of one car over the steps of a plan, the fields of its `ms_highway.game.dynamics.Motion` stacked."""
