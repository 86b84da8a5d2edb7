"""Define the scene: lanes, obstacles and bodies; find the neighbours of a driver."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple, TypeAlias, get_args

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.geometry.curve import namespace
from ms_highway.runtime.arrays import (
    Array,
    Numbers,
    Numeric,
    SameArray,
    Scalar,
)

Contact: TypeAlias = Literal["paper", "bodies"]

PAPER_UNIT = 100 / 3
"""The paper's unit of length [m]."""


@dataclass(frozen=True)
class PaperSizes:
    """Sizes in the paper's scenes."""

    car: tuple[float, float] = (0.15 * PAPER_UNIT, 0.075 * PAPER_UNIT)
    """Length and width of cars [m]: 5 by 2.5."""
    cone: tuple[float, float] = (0.07 * PAPER_UNIT, 0.0561166667 * PAPER_UNIT)
    """Length and width of cones [m]: 2.3 by 1.9."""
    lane_width: float = 0.1 * PAPER_UNIT
    """Width of lanes [m]: 3.3."""


PAPER_SIZES = PaperSizes()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Scene:
    """A straight road along x with obstacles on it.

    All lengths are in metres, y points to the right.

    Attributes:
        lanes: lateral position of each lane's centre, array [lanes].
        lane_width: width of a lane; the road ends half of it beyond the outermost
            centres.
        obstacles: centres (x, y) of static obstacles, which are parallel to the axes,
            array [n, 2]; none by default.
        obstacle_size: length and width of every obstacle, array [2]; a cone of the
            paper by default.
        car_size: length and width of every car, array [2]; 5 by 2.5 m by default.
        corner: position of the outermost body points of the collision feature, as a
            share of length and width; by default 1/2, the corner of the body.
        target_lane: lateral position of the lane that a merging car enters; only for
            rewards that weigh it.
        length_unit: unit of lengths in features [m]. Weights depend on it; those of the
            package are for the paper's unit, 100/3 m, the default.
        bend: curvature of the road [1/m], positive to the right; the coordinates
            straighten it. None on a straight road.
        leader: index of the car that the gap feature refers to, None without one
            (static).
        contact: what counts as a collision (static). ``paper``: any of nine points of
            the car is inside an ellipse within another body. ``bodies``: the car's
            rectangle overlaps the rectangle of another car or the circle of an
            obstacle, whose diameter is the obstacle's width. All else, such as the room
            to stop before obstacles, goes by the obstacle's length and width.

    Raises:
        ValueError: for an impossible number or shape, naming the attribute; arrays of
            JAX are not checked.
    """

    arrival_tolerance: ClassVar[float] = 0.8
    """Distance from the centre of the target lane at which a car has reached it [m]."""

    shapes: ClassVar[dict[str, tuple[str | int, ...]]] = {
        "lanes": ("n",),
        "obstacles": ("n", 2),
        "obstacle_size": (2,),
        "car_size": (2,),
    }
    """Shapes of the arrays; n may be any number."""

    lanes: Float[Array, "lanes"]
    lane_width: Scalar
    obstacles: Float[Array, "obstacles 2"] = field(
        default_factory=lambda: np.zeros((0, 2))
    )
    obstacle_size: Float[Array, "2"] | tuple[float, float] = PAPER_SIZES.cone
    car_size: Float[Array, "2"] | tuple[float, float] = PAPER_SIZES.car
    corner: Scalar = 0.5
    target_lane: Scalar = 0.0
    length_unit: Scalar = PAPER_UNIT
    bend: Scalar | None = None
    leader: int | None = field(default=None, metadata={"static": True})
    contact: Contact = field(default="paper", metadata={"static": True})

    @property
    def bodies_collide(self) -> bool:
        """Whether a collision is an overlap of bodies, see ``contact``."""
        return self.contact == "bodies"

    def is_reached(self, y: Numbers) -> Bool[Array, "..."] | np.bool:
        """Return whether cars at lateral positions have reached the target lane."""
        distance = y - float(self.target_lane)
        return namespace(y).abs(distance) < self.arrival_tolerance

    def __post_init__(self) -> None:
        for name, shape in self.shapes.items():
            self._check_array(name, shape)
        if self.contact not in get_args(Contact):
            known = ", ".join(get_args(Contact))
            raise ValueError(f"Scene.contact is {self.contact!r}; give one of {known}")
        size = self.car_size
        if isinstance(size, np.ndarray):
            is_possible = (size > 0) & (size < np.inf)
            if not is_possible.all():
                raise ValueError(
                    f"Scene.car_size is {size.tolist()}; give length and width in"
                    " metres, both positive"
                )
        width = self.lane_width
        is_known = isinstance(width, (int, float, np.ndarray, np.number))
        if is_known and not np.all(np.asarray(width) >= 0):
            raise ValueError(f"Scene.lane_width is {width}; it must not be negative")

    def _check_array(self, name: str, shape: tuple[str | int, ...]) -> None:
        """Make an attribute that is a list or a tuple an array, and check its shape.

        Raises:
            ValueError: for another shape, or NaN.
        """
        value = getattr(self, name)
        if isinstance(value, (list, tuple)):
            value = np.asarray(value, dtype=float)
            object.__setattr__(self, name, value)
        if not isinstance(value, np.ndarray):
            return  # an array of JAX
        has_axes = value.ndim >= len(shape)
        fits = has_axes and shape[-1] in ("n", value.shape[-1])
        if not fits or np.isnan(value).any():
            wanted = ", ".join(map(str, shape))
            raise ValueError(
                f"Scene.{name} is {value.tolist()}; give an array [{wanted}] of"
                " numbers, in metres"
            )


# Neighbours of a driver: the nearest cars ahead and behind, in its own lane and in the
# adjacent ones

FAR_AWAY = 1000.0
"""Distance behind a driver at which cars that are absent or do not matter are put [m].
"""


def places(
    driver: Float[SameArray, "*batch 4"],
    others: Float[SameArray, "*batch cars 4"],
    present: Bool[SameArray, "*batch cars"],
    lane_width: float | Float[SameArray, "*batch"],
) -> tuple[Int[SameArray, "*batch 6"], Bool[SameArray, "*batch 6"]]:
    """Return which of the others takes each place around a driver, and if any does.

    The six places are ahead and behind in the driver's own lane, in the lane to the
    left, and in that to the right. A car is in the driver's lane if it is less than
    half a lane's width to the side.

    Args:
        driver: state of the driver.
        others: states of the other cars, in the same coordinates, along the road.
        present: which of the others exist; states of absent cars may be anything, even
            NaN.
        lane_width: of a lane [m].
    """
    xp = driver.__array_namespace__()
    lanes_to_right = np.array([0, 0, -1, -1, 1, 1], dtype=np.float32)  # of each place
    is_ahead = np.array([True, False, True, False, True, False])

    # Which place each car is at [*batch, cars, 6].
    offset = others[..., :2] - driver[..., None, :2]
    widths = xp.asarray(lane_width)[..., None]
    lane = xp.round(offset[..., 1] / widths)
    ahead = offset[..., 0] > 0
    in_lane = lane[..., None] == lanes_to_right
    on_side = ahead[..., None] == is_ahead
    fits = in_lane & on_side & present[..., None]

    # The nearest car at each place [*batch, 6].
    along = xp.abs(offset[..., :1])
    distance = xp.where(fits, along, xp.inf)
    nearest = xp.argmin(distance, axis=-2)
    return nearest, xp.any(fits, axis=-2)


def neighbours(
    driver: Float[SameArray, "*batch 4"],
    others: Float[SameArray, "*batch cars 4"],
    present: Bool[SameArray, "*batch cars"],
    lane_width: float | Float[SameArray, "*batch"],
) -> Float[SameArray, "*batch 6 4"]:
    """Return the states of a driver's neighbours in the six `places`.

    An empty place holds a standing car far behind, so that the shape never changes.
    """
    xp = driver.__array_namespace__()
    cars, taken = places(driver, others, present, lane_width)
    found = xp.take_along_axis(others, cars[..., None], axis=-2)
    absent = far_behind(driver)[..., None, :]
    return xp.where(taken[..., None], found, absent)


def headways(
    driver: Float[SameArray, "*batch 4"],
    around: Float[SameArray, "*batch 6 4"],
    length: Scalar,
) -> Float[SameArray, "*batch 6"]:
    """Return the time gaps between a driver and its neighbours [s].

    They are distances between bumpers over the speed of the rear car.

    Args:
        driver: state of the driver.
        around: states of its `neighbours`.
        length: of cars [m].
    """
    xp = driver.__array_namespace__()
    along = around[..., 0] - driver[..., :1]
    rear_speed = xp.where(along > 0, driver[..., 3:], around[..., 3])
    gap = xp.maximum(xp.abs(along) - length, 0.0)
    least_speed = 1.0  # m/s; headways of standing cars would be infinite
    return gap / xp.maximum(rear_speed, least_speed)


def far_behind(driver: Float[SameArray, "*batch 4"]) -> Float[SameArray, "*batch 4"]:
    """Return the state of a standing car that is too far behind a driver to matter."""
    xp = driver.__array_namespace__()
    x = driver[..., 0] - FAR_AWAY
    y = driver[..., 1]
    zero = xp.zeros_like(y)
    return xp.stack([x, y, zero, zero], axis=-1)


class Leader(NamedTuple):
    """The car ahead.

    Attributes:
        gap: between bumpers [m].
        speed: along the road [m/s].
        there: whether there is one.
    """

    gap: Numeric
    speed: Numeric
    there: Bool[Array, "*cars"] | np.bool


def leaders(
    x: Float[SameArray, "*batch cars"],
    lane: Float[SameArray, "*batch cars"],
    others: Float[SameArray, "*batch others 4"],
    counts: Bool[Array, "*#batch #cars others"],
    reach: Numeric,
) -> tuple[Int[SameArray, "*batch cars"], Bool[SameArray, "*batch cars"]]:
    """Return which of the others is each car's leader in a lane, and whether any is.

    The leader is the nearest one ahead.

    Args:
        x: position of each car along the road [m].
        lane: lateral position of the centre of the lane in which each car looks ahead
            [m].
        others: states of all cars that may be ahead.
        counts: which of them count for each car; states of the rest may be anything.
        reach: lateral distance from the lane's centre up to which a car is in the lane
            [m].
    """
    xp = others.__array_namespace__()
    others_x = others[..., None, :, 0]
    others_y = others[..., None, :, 1]
    distance = others_x - x[..., None]  # [*batch, cars, others]
    offset = others_y - lane[..., None]
    in_lane = xp.abs(offset) <= reach
    return nearest_ahead(distance, counts & in_lane)
