"""Name the arrays of plans on roads, of JAX or NumPy; floats unless stated otherwise."""

from typing import Any

from jaxtyping import Bool, Float, Int

Scalar = float | Float[Any, ""]
Steps = Float[Any, "*shape steps"]
Control = Float[Any, "*shape 2"]
Controls = Float[Any, "*plans steps 2"]
States = Float[Any, "*plans steps 4"]
Motion = Float[Any, "7 steps"]
Lane = int | Int[Any, "*plans"]
Plans = Float[Any, "plans"]
PlanFlags = Bool[Any, "plans"]
EachCar = Float[Any, "*plans traffic"]
EachFlag = Bool[Any, "*plans traffic"]
EachStep = Float[Any, "*plans traffic steps"]
Values = Float[Any, "lanes places speeds"]
Matrix = Float[Any, "n n"]

Trajectory = Float[Any, "4 steps"]
"""x, y, heading and speed after each step, in world coordinates."""

Trajectories = Float[Any, "*plans traffic 4 steps"]
