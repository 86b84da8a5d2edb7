"""Arrays of learning and prediction, of NumPy or JAX."""

from typing import Any

from jaxtyping import Bool, Float, Int

Scalar = Float[Any, ""]
Values = Float[Any, "n"]
Flags = Bool[Any, "n"]
Numbers = Int[Any, "n"]

Points = Float[Any, "points 2"]
States = Float[Any, "*times 4"]  # x, y, heading and speed
Controls = Float[Any, "*n steps 2"]

Paths = Float[Any, "n 50 2"]  # x and y after each step of 5 s
Steps = Float[Any, "n 50"]  # a value after each step

Cars = Float[Any, "*n cars"]
CarFlags = Bool[Any, "*n cars"]
CarNumbers = Int[Any, "*n cars"]
CarStates = Float[Any, "*n cars 4"]
Traits = Float[Any, "cars 3"]  # logarithms, as deviations from those of the medians

Parameters = Float[Any, "parameters"]
