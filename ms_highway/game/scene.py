"""Define the scene: lanes, obstacles, the size of cars, and the leader."""

from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.runtime.arrays import Array, Scalar

PAPER_UNIT = 100 / 3  # m
CAR_SIZE = (0.15 * PAPER_UNIT, 0.075 * PAPER_UNIT)  # m: 5 by 2.5
CONE_SIZE = (0.07 * PAPER_UNIT, 0.0561166667 * PAPER_UNIT)  # m

LANE_TOLERANCE = 0.8  # m, from the centre of the target lane, within which a car has reached it

SHAPES: dict[str, tuple[str | int, ...]] = {
    "lanes": ("n",),
    "obstacles": ("n", 2),
    "obstacle_size": (2,),
    "car_size": (2,),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """A straight road along x with obstacles on it. All lengths are in metres, y points to the right.

    Attributes:
        lanes: lateral position of each lane's centre, array [lanes].
        lane_width: width of a lane; the road ends half of it beyond the outermost centres.
        obstacles: centres (x, y) of static obstacles, which are parallel to the axes, array [n, 2]; none by default.
        obstacle_size: length and width of every obstacle, array [2]; a cone of the paper by default.
        car_size: length and width of every car, array [2]; 5 by 2.5 m by default.
        corner: position of the outermost body points of the collision feature, as a share of length and width; by
            default 1/2, the corner of the body.
        target_lane: lateral position of the lane that a merging car enters; only for rewards that weigh it.
        length_unit: unit of lengths in features [m]. Weights depend on it; those of the package are for the paper's
            unit, 100/3 m, the default.
        bend: curvature of the road [1/m], positive to the right; the coordinates straighten it. None on a straight
            road.
        leader: index of the car that the gap feature refers to, None without one (static).

    Raises:
        ValueError: for an impossible number or shape, naming the attribute; arrays of JAX are not checked.
    """

    lanes: Float[Array, "lanes"]
    lane_width: Scalar
    obstacles: Float[Array, "obstacles 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    obstacle_size: Float[Array, "2"] = CONE_SIZE
    car_size: Float[Array, "2"] = CAR_SIZE
    corner: Scalar = 0.5
    target_lane: Scalar = 0.0
    length_unit: Scalar = PAPER_UNIT
    bend: Scalar | None = None
    leader: int | None = field(default=None, metadata={"static": True})

    def is_reached(self, y: Any) -> Any:
        """Return whether cars at these lateral positions have reached the target lane."""
        return abs(y - float(self.target_lane)) < LANE_TOLERANCE

    def __post_init__(self) -> None:
        for name, shape in SHAPES.items():
            value = getattr(self, name)
            if isinstance(value, (list, tuple)):
                value = np.asarray(value, dtype=float)
                object.__setattr__(self, name, value)
            if not isinstance(value, np.ndarray):
                continue  # an array of JAX
            if value.ndim < len(shape) or shape[-1] not in ("n", value.shape[-1]) or np.isnan(value).any():
                wanted = ", ".join(map(str, shape))
                raise ValueError(f"Scene.{name} is {value.tolist()}; give an array [{wanted}] of numbers, in metres")
        size, width = self.car_size, self.lane_width
        if isinstance(size, np.ndarray) and not ((size > 0) & (size < np.inf)).all():
            raise ValueError(f"Scene.car_size is {size.tolist()}; give length and width in metres, both positive")
        if isinstance(width, (int, float, np.ndarray, np.number)) and not np.all(np.asarray(width) >= 0):
            raise ValueError(f"Scene.lane_width is {width}; it must not be negative")
