"""Name arrays of driving by their shapes; all may be of NumPy or of JAX."""

from typing import Any, TypeAlias

from jaxtyping import Bool, Float, Int

Scalar: TypeAlias = Float[Any, ""]
Number: TypeAlias = float | Scalar

Car: TypeAlias = Float[Any, "4"]  # x, y [m], heading [rad], speed [m/s]
State: TypeAlias = Float[Any, "cars 4"]  # robot, humans, scripted cars
Control: TypeAlias = Float[Any, "2"]  # omega, acceleration
Controls: TypeAlias = Float[Any, "steps 2"]
ManyControls: TypeAlias = Float[Any, "*batch steps 2"]
HumansControl: TypeAlias = Float[Any, "humans 2"]
HumansControls: TypeAlias = Float[Any, "humans steps 2"]

Trajectory: TypeAlias = Float[Any, "fields steps"]  # the fields of a `ms_highway.game.dynamics.Motion`
Trajectories: TypeAlias = Float[Any, "cars fields steps"]
Times: TypeAlias = Float[Any, "*times"]

Weights: TypeAlias = Float[Any, "features"]
HumansWeights: TypeAlias = Float[Any, "humans features"]

Index: TypeAlias = int | Int[Any, ""]
Rungs: TypeAlias = Int[Any, "humans"]  # the place on the ladder of every human's model
Gains: TypeAlias = Float[Any, "humans rungs"]
Belief: TypeAlias = Float[Any, "humans models"]
Flag: TypeAlias = Bool[Any, ""]
Vector: TypeAlias = Float[Any, "n"]
Matrix: TypeAlias = Float[Any, "n n"]
