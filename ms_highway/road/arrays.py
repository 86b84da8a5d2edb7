"""Name the arrays of plans on roads by their shapes; all may be of NumPy or of JAX, floats unless stated otherwise."""

from typing import Any

from jaxtyping import Bool, Float, Int

Steps = Float[Any, "*shape steps"]
States = Float[Any, "*plans steps 4"]
Lane = Int[Any, "*plans"]
Plans = Float[Any, "plans"]
PlanFlags = Bool[Any, "plans"]
EachCar = Float[Any, "*plans traffic"]
EachFlag = Bool[Any, "*plans traffic"]
EachStep = Float[Any, "*plans traffic steps"]
Values = Float[Any, "lanes places speeds"]

World = Float[Any, "*shape 4 steps"]
"""x, y, heading and speed of cars after each step, in world coordinates."""
