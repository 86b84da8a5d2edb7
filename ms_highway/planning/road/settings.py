"""What plans on roads may do and want."""

from dataclasses import dataclass, field

import jax
from jaxtyping import Float

from ms_highway.runtime.arrays import Array

__all__ = ["CORNERING", "RUNGS", "RoadPlanning"]

RUNGS = ("naive", "idm", "turn", "tom")
"""Names of the models that predict traffic, cheapest first: keep the velocity along the lane; follow by IDM; optimise
the own reward while the robot keeps its velocity; answer the robot's plan optimally (theory of mind)."""

CORNERING = 0.85
"""Share of the grip that bends may take."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RoadPlanning:
    """Limits and wishes of a robot on a road.

    Attributes:
        desired_speed: [m/s].
        grip: total acceleration at most, the radius of the friction circle [m/s^2].
        curvature: of the path at most [1/m].
        time_step: of plans [s].
        steps: of plans (static).
    """

    desired_speed: float | Float[Array, ""] = 30.0
    grip: float | Float[Array, ""] = 5.0
    curvature: float | Float[Array, ""] = 0.2
    time_step: float | Float[Array, ""] = 0.2
    steps: int = field(default=20, metadata={"static": True})
