"""Define the scene: lanes, obstacles, the size of cars, and the leader."""

from dataclasses import dataclass, field

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.runtime.arrays import Array

__all__ = ["Scene"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """A straight road along x with obstacles on it. All lengths are in metres, y points to the right.

    Attributes:
        lanes: lateral position of each lane's centre.
        lane_width: width of a lane; the road ends half of it beyond the outermost centres.
        obstacles: centres (x, y) of the static obstacles, which are parallel to the axes.
        obstacle_size: length and width of every obstacle.
        car_size: length and width of every car.
        corner: position of the outermost body points of the collision feature, as a share of length and width (1/2 is
            the corner of the body).
        target_lane: lateral position of the lane that a merging car enters.
        length_unit: unit of lengths in features [m]; 100/3 in the paper's units.
        bend: curvature of the road [1/m], positive to the right, which its coordinates straighten; None on a straight
            road.
        leader: index of the car that the gap feature refers to, None without one (static).

    Raises:
        ValueError: if cars have no size; arrays of JAX are not checked.
    """

    lanes: Float[Array, "lanes"]
    lane_width: float | Float[Array, ""]
    obstacles: Float[Array, "obstacles 2"]
    obstacle_size: Float[Array, "2"]
    car_size: Float[Array, "2"]
    corner: float | Float[Array, ""]
    target_lane: float | Float[Array, ""]
    length_unit: float | Float[Array, ""]
    bend: float | Float[Array, ""] | None = None
    leader: int | None = field(default=None, metadata={"static": True})

    def __post_init__(self) -> None:
        size = self.car_size
        if isinstance(size, np.ndarray) and not ((size > 0) & (size < np.inf)).all():
            raise ValueError(f"Scene.car_size is {size.tolist()}; give length and width in metres, both positive")
