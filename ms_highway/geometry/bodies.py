"""Compute distances and overlaps of bodies, and find the nearest body ahead.

All functions take arrays of NumPy or JAX.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.geometry.curve import namespace
from ms_highway.runtime.arrays import (
    Array,
    Numbers,
    Numeric,
    SameArray,
    Scalar,
)

CORNERS = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)], dtype=np.float32)
"""Sides of the corners of a body, along and across it."""

MIDDLES = np.array([(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5), (0, 0)], dtype=np.float32)
"""Middles of the edges and of the body, in shares of its size."""

Sizes = Float[Array, "... 2"]
AnySizes = Sizes | tuple[float, float]
AnyPose = tuple[Numeric, Numeric, Numeric]
Flags = Bool[Array, "..."]
Directions = tuple[Numeric, Numeric]
"""Numbers along and across a body."""

Directed = tuple[Numeric, Numeric, Numeric, Numeric]
"""x, y [m], and cosine and sine of the heading."""


def separation(
    own: AnyPose,
    size: AnySizes,
    other: AnyPose,
    sizes: AnySizes,
) -> Numbers:
    """Return the distance between rectangles along the best separating axis [m].

    It is negative if they overlap.

    Args:
        own: x, y and heading of the first.
        size: length and width of the first [m].
        other: x, y and heading of the second.
        sizes: length and width of the second [m].
    """
    xp = namespace(*own, size, *other, sizes)

    def directed(pose: AnyPose) -> Directed:
        x, y, heading = pose
        return x, y, xp.cos(heading), xp.sin(heading)

    length, width = xp.moveaxis(xp.asarray(size), -1, 0)
    other_length, other_width = xp.moveaxis(xp.asarray(sizes), -1, 0)
    return separation_of_directed(
        directed(own), directed(other), (length, width), (other_length, other_width)
    )


def separation_of_directed(
    own: Directed,
    other: Directed,
    size: Directions,
    other_size: Directions,
) -> Numbers:
    """Return the `separation` of rectangles with headings by cosine and sine.

    Args:
        own: motion of the first.
        other: motion of the second.
        size: length and width of the first [m].
        other_size: length and width of the second [m].
    """
    own_x, own_y, own_cosine, own_sine = own
    other_x, other_y, other_cosine, other_sine = other
    xp = namespace(*own, *other)

    # Cosine and sine of the angle between both.
    parallel = xp.abs(own_cosine * other_cosine + own_sine * other_sine)
    slanted = xp.abs(own_cosine * other_sine - own_sine * other_cosine)

    def gap(place: Directions, one: Directions, two: Directions) -> Numbers:
        """Return the larger gap in the first one's frame, to the box around the second.

        Args:
            place: of the second, along and across the first [m].
            one: length and width of the first [m].
            two: length and width of the second [m].
        """
        along = xp.abs(place[0])
        across = xp.abs(place[1])
        half_length = two[0] / 2
        half_width = two[1] / 2

        # From the side of the first to the nearest corner of the second.
        from_end = along - one[0] / 2
        gap_along = from_end - half_length * parallel - half_width * slanted
        from_side = across - one[1] / 2
        gap_across = from_side - half_length * slanted - half_width * parallel
        return xp.maximum(gap_along, gap_across)

    place_of_other = place_in_frame(own, other_x, other_y)
    gap_from_own = gap(place_of_other, size, other_size)
    place_of_own = place_in_frame(other, own_x, own_y)
    gap_from_other = gap(place_of_own, other_size, size)
    return xp.maximum(gap_from_own, gap_from_other)


def circles_overlap(
    along: Numeric,
    across: Numeric,
    size: Directions,
    radius: Numeric,
) -> Flags:
    """Return whether circles overlap a rectangle: whether it is within their radius.

    Args:
        along: places of the centres, from the rectangle's centre along its axis [m].
        across: places of the centres across its axis [m].
        size: length and width of the rectangle [m].
        radius: of the circles [m].
    """
    xp = namespace(along, across)
    from_end = xp.abs(along) - size[0] / 2
    from_side = xp.abs(across) - size[1] / 2
    beyond_end = xp.maximum(from_end, 0.0)
    beyond_side = xp.maximum(from_side, 0.0)
    squared_distance = beyond_end**2 + beyond_side**2
    return squared_distance < radius**2


def place_in_frame(own: Directed, x: Numeric, y: Numeric) -> Directions:
    """Return where places are, along and across a body, from its centre [m]."""
    own_x, own_y, cosine, sine = own
    dx = x - own_x
    dy = y - own_y
    along = cosine * dx + sine * dy
    across = cosine * dy - sine * dx
    return along, across


def body_points(size: AnySizes, corner: Scalar) -> Float[Array, "9 2"]:
    """Return x and y of nine points of a body in its own frame [m].

    They are the corners, the middles of the edges and the centre.

    Args:
        size: length and width [m].
        corner: position of the corners as a share of the size.
    """
    xp = namespace(size, corner)
    in_sizes = xp.concatenate([corner * CORNERS, MIDDLES])
    return in_sizes * xp.asarray(size)


def point_offsets(
    own: Directed,
    points: Float[Array, "points 2"],
    other: Directed,
) -> tuple[Float[Array, "bodies points *times"], Float[Array, "bodies points *times"]]:
    """Return where points of a body are, along and across other bodies [m].

    Args:
        own: motion of the body, arrays [*times] or numbers.
        points: of the body, in its own frame [m].
        other: motion of the other bodies, arrays [bodies, *times].
    """
    other_x, other_y, other_cosine, other_sine = other
    xp = namespace(*own, *other)
    times = np.ndim(other_x) - 1

    # Offset and direction of the body in the frames of the others [bodies, *times].
    shape = np.shape(other_x)
    x, y, cosine, sine = (xp.broadcast_to(part, shape) for part in own)
    dx = x - other_x
    dy = y - other_y
    ahead = other_cosine * dx + other_sine * dy
    across = other_cosine * dy - other_sine * dx
    turned = other_cosine * cosine + other_sine * sine
    slant = other_cosine * sine - other_sine * cosine

    # All with an axis of points [bodies, points, *times].
    with_points = (len(dx), len(points), *dx.shape[1:])
    ahead, across, turned, slant = (
        xp.broadcast_to(part[:, None], with_points)
        for part in (ahead, across, turned, slant)
    )
    of_points = points.T.reshape(2, 1, -1, *[1] * times)
    along, aside = xp.broadcast_to(of_points, (2, *with_points))

    # Turn the points into the frames of the others.
    point_ahead = ahead + turned * along - slant * aside
    point_across = across + slant * along + turned * aside
    return point_ahead, point_across


def ellipse_distance(
    own: Directed,
    points: Float[Array, "points 2"],
    other: Directed,
    length: Numbers,
    width: Numbers,
) -> Float[Array, "bodies points *times"]:
    """Return ``D - 1 = (2 dx / length)^2 + (2 dy / width)^2 - 1`` to other bodies.

    It is the distance from points of a body. The offset (dx, dy) of a point is in the
    frame of the other body; ``D < 1`` is the ellipse inscribed in it.

    Args:
        own: motion of the body, arrays [*times] or numbers.
        points: of the body, in its own frame [m].
        other: motion of the other bodies, arrays [bodies, *times].
        length: of the other bodies [m], a number or an array [bodies, 1, *ones] that
            broadcasts over points and times.
        width: of the other bodies, likewise.
    """
    x, y = point_offsets(own, points, other)
    along = x / (length / 2)
    across = y / (width / 2)
    return along**2 + across**2 - 1


def square_distance(x: Numbers, y: Numbers) -> Numbers:
    """Return D of points near a body, ``D^2 = x^4 + y^4``.

    Lines of equal D are superellipses, nearly rectangles with round corners. ``D = 1``
    touches the sides of the body, ``D = sqrt(2)`` goes through its corners and encloses
    it. D is convex, and grows like a square with the distance from the centre.

    Args:
        x: along the body, in shares of half its length.
        y: across the body, in shares of half its width.
    """
    xp = namespace(x, y)
    least = 1e-6  # keeps the derivatives of the root finite
    return xp.sqrt(x**4 + y**4 + least)


def nearest_ahead(
    distance: Float[SameArray, "*batch others"],
    counts: Bool[Array, "*#batch others"],
) -> tuple[Int[SameArray, "*batch"], Bool[SameArray, "*batch"]]:
    """Return which of the others is the nearest ahead, and whether any is.

    Args:
        distance: to the others, positive ahead [m].
        counts: which of the others count, such as those in the same lane; distances to
            the rest may be anything.
    """
    xp = namespace(distance, counts)
    is_ahead = counts & (distance > 0)
    distance_ahead = xp.where(is_ahead, distance, xp.inf)
    nearest = xp.argmin(distance_ahead, axis=-1)
    return nearest, xp.any(is_ahead, axis=-1)
