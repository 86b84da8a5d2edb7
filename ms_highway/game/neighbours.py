"""Find the neighbours of a driver: the nearest cars ahead and behind, in its own lane and in the adjacent ones."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.runtime.arrays import SameArray

MIN_FOLLOWER_SPEED = 1.0  # m/s, by which headways are divided at least
FAR_AWAY = 1000.0  # m behind, where absent cars are

SIDES = np.array([0, 0, -1, -1, 1, 1], dtype=np.float32)  # lanes to the right, of each place
AHEAD = np.array([True, False] * 3)  # whether a place is ahead


def places(
    driver: Float[SameArray, "*batch 4"],
    others: Float[SameArray, "*batch cars 4"],
    present: Bool[SameArray, "*batch cars"],
    lane_width: float | Float[SameArray, "*batch"],
) -> tuple[Int[SameArray, "*batch 6"], Bool[SameArray, "*batch 6"]]:
    """Return which of the others takes each of the six places around a driver, and whether any car does.

    A car is in the driver's lane if it is less than half a lane's width to the side.

    Args:
        driver: state of the driver.
        others: states of the other cars, in the same coordinates, along the road.
        present: which of the others exist; states of absent cars may be anything, even NaN.
        lane_width: of a lane [m].
    """
    xp = driver.__array_namespace__()
    offset = others[..., :2] - driver[..., None, :2]
    lane = xp.round(offset[..., 1] / xp.asarray(lane_width)[..., None])
    ahead = offset[..., 0] > 0
    fits = (lane[..., None] == SIDES) & (ahead[..., None] == AHEAD) & present[..., None]
    distance = xp.where(fits, xp.abs(offset[..., :1]), xp.inf)
    return xp.argmin(distance, axis=-2), xp.any(fits, axis=-2)


def neighbours(
    driver: Float[SameArray, "*batch 4"],
    others: Float[SameArray, "*batch cars 4"],
    present: Bool[SameArray, "*batch cars"],
    lane_width: float | Float[SameArray, "*batch"],
) -> Float[SameArray, "*batch 6 4"]:
    """Return the states of a driver's neighbours in the six places, see `places` for the arguments.

    An empty place holds a standing car far behind, so that the shape never changes.
    """
    xp = driver.__array_namespace__()
    cars, taken = places(driver, others, present, lane_width)
    found = xp.take_along_axis(others, cars[..., None], axis=-2)
    return xp.where(taken[..., None], found, far_behind(driver)[..., None, :])


def headways(
    driver: Float[SameArray, "*batch 4"],
    around: Float[SameArray, "*batch 6 4"],
    length: float,
) -> Float[SameArray, "*batch 6"]:
    """Return the time gaps between a driver and its neighbours [s]: bumper distance over the speed of the rear car.

    Args:
        driver: state of the driver.
        around: states of its `neighbours`.
        length: of cars [m].
    """
    xp = driver.__array_namespace__()
    along = around[..., 0] - driver[..., :1]
    follower = xp.where(along > 0, driver[..., 3:], around[..., 3])
    return xp.maximum(xp.abs(along) - length, 0.0) / xp.maximum(follower, MIN_FOLLOWER_SPEED)


def far_behind(driver: Float[SameArray, "*batch 4"]) -> Float[SameArray, "*batch 4"]:
    """Return the state of a standing car that is too far behind a driver to matter."""
    xp = driver.__array_namespace__()
    zero = xp.zeros_like(driver[..., 0])
    return xp.stack([driver[..., 0] - FAR_AWAY, driver[..., 1], zero, zero], axis=-1)


class Leader(NamedTuple):
    """The car ahead.

    Attributes:
        gap: between bumpers [m].
        speed: along the road [m/s].
        there: whether there is one.
    """

    gap: Float[Any, "*cars"]
    speed: Float[Any, "*cars"]
    there: Bool[Any, "*cars"]


def leaders(
    x: Float[Any, "*batch cars"],
    lane: Float[Any, "*batch cars"],
    others: Float[Any, "*batch others 4"],
    counts: Bool[Any, "*#batch #cars others"],
    reach: float | Float[Any, "*#batch #cars #others"],
) -> tuple[Int[Any, "*batch cars"], Bool[Any, "*batch cars"]]:
    """Return which of the others is the nearest one ahead in a lane, and whether there is one; of NumPy or JAX.

    Args:
        x: position of each car along the road [m].
        lane: lateral position of the centre of the lane in which each car looks ahead [m].
        others: states of all cars that may be ahead.
        counts: which of them count for each car; states of the rest may be anything.
        reach: lateral distance from the lane's centre up to which a car is in the lane [m].
    """
    xp = others.__array_namespace__()
    distance = others[..., None, :, 0] - x[..., None]
    return nearest_ahead(distance, counts & (xp.abs(others[..., None, :, 1] - lane[..., None]) <= reach))
