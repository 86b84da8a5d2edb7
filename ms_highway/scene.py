"""The scene that cars drive in: lanes, obstacles, the cars' bodies, and who follows whom."""

from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.dynamics import Array

__all__ = ["Scene", "from_road"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """A straight road along x with obstacles on it. All lengths are in metres, y points to the right.

    Attributes:
        lanes: lateral position of each lane's centre.
        lane_width: width of a lane; the road ends half of it beyond the outermost centres.
        obstacles: centres (x, y) of the static obstacles, which lie along the axes.
        obstacle_size: length and width of every obstacle.
        car_size: length and width of every car.
        corner: position of the outermost body points that the collision feature looks at, as a share of length
            and width (1/2 is the very corner).
        target_lane: lateral position of the lane that a merging car is heading for.
        length_unit: the length that features count in [m]; 100/3 in the paper's units.
        leader: index of the car in whose gap a car may settle, None without one (static).
    """

    lanes: Float[Array, "lanes"]
    lane_width: float | Float[Array, ""]
    obstacles: Float[Array, "obstacles 2"]
    obstacle_size: Float[Array, "2"]
    car_size: Float[Array, "2"]
    corner: float | Float[Array, ""]
    target_lane: float | Float[Array, ""]
    length_unit: float | Float[Array, ""]
    leader: int | None = field(default=None, metadata={"static": True})


def from_road(road: Any, car_size: tuple[float, float], length_unit: float) -> Scene:
    """The scene on a highway-env road: its lanes, and its objects as obstacles.

    Args:
        road: a `highway_env.road.road.Road`.
        car_size: length and width of every car [m].
        length_unit: the length that features count in [m].

    Returns:
        The scene; its target lane is the leftmost one, and the largest object gives the size of all obstacles.

    Raises:
        ValueError: if a lane is not straight along x.
    """
    lanes = road.network.lanes_list()
    for lane in lanes:
        sides = [lane.position(share * lane.length, 0)[1] for share in (0.0, 0.5, 1.0)]
        if np.ptp(sides) > 1e-3 or lane.heading_at(0) != 0:
            raise ValueError(
                f"the lane from {lane.position(0, 0)} to {lane.position(lane.length, 0)} is not straight along x; "
                "a scene needs straight lanes, so build the Scene by hand or drive another vehicle here"
            )
    centres = np.unique([lane.position(0, 0)[1] for lane in lanes])
    obstacles = np.array([item.position for item in road.objects], dtype=float).reshape(-1, 2)
    sizes = np.array([(item.LENGTH, item.WIDTH) for item in road.objects], dtype=float).reshape(-1, 2)
    return Scene(
        lanes=centres,
        lane_width=min(lane.width for lane in lanes),
        obstacles=obstacles,
        obstacle_size=sizes.max(axis=0, initial=1e-3),
        car_size=np.array(car_size),
        corner=0.5,
        target_lane=centres[0],
        length_unit=length_unit,
    )
