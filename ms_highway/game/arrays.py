"""Name arrays of driving by their shapes; all may be of NumPy or of JAX."""

from typing import Any, TypeAlias

from jaxtyping import Float, Int

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
