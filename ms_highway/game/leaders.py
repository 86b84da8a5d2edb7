"""Find the car ahead: the nearest one in a lane."""

from typing import Any, NamedTuple

from jaxtyping import Bool, Float, Int


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
    """Return which of the others is the nearest ahead in a lane, and whether any is; arrays of NumPy or JAX.

    Args:
        x: position of each car along the road [m].
        lane: lateral position of the centre of the lane in which each looks ahead [m].
        others: states of all that may be ahead.
        counts: which of them count for each car; of the rest, states may be anything.
        reach: lateral distance from that centre up to which a car is in the lane [m].
    """
    xp = others.__array_namespace__()
    distance = others[..., None, :, 0] - x[..., None]
    ahead = counts & (distance > 0) & (xp.abs(others[..., None, :, 1] - lane[..., None]) <= reach)
    return xp.argmin(xp.where(ahead, distance, xp.inf), axis=-1), xp.any(ahead, axis=-1)
