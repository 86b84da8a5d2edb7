"""Read numbers, intervals and shapes from elements of CommonRoad's XML.

All functions raise a ``ValueError`` that names the element and the value for anything
that is missing, no number, or larger than a scenario can have. The functions know no
version of the format: what the elements of a scenario are called and how they belong
together stands in `ms_highway.recorded.commonroad`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar
from xml.etree.ElementTree import Element

import numpy as np

from ms_highway.geometry.curve import rotated
from ms_highway.recorded.scenario import Points
from ms_highway.runtime.arrays import Numeric

Read = TypeVar("Read")


@dataclass(frozen=True)
class LargestNumbers:
    """Set the largest numbers that elements may have; larger ones are damage."""

    step: float = 1e5
    """Steps of time: almost three hours."""
    speed: float = 200.0
    """[m/s]."""
    angle: float = 1e3
    """[rad]. Orientations need not be within a turn."""
    coordinate: float = 1e8
    """[m]. Maps may be in UTM coordinates, of up to 1e7 m."""


LARGEST_NUMBERS = LargestNumbers()


def read_each(
    root: Element,
    tag: str,
    read: Callable[[int, Element], Read],
) -> dict[int, Read]:
    """Return what ``read`` makes of each element with a tag, by the elements' ids.

    Raises:
        ValueError: naming the tag and the id of the element.
    """
    results: dict[int, Read] = {}
    for element in root.iterfind(tag):
        try:
            number = int(element.get("id", ""))
            if number in results:
                raise ValueError("another one has the same id")
            results[number] = read(number, element)
        except ValueError as error:
            raise ValueError(f"{tag} {element.get('id', '')[:40]}: {error}") from error
    return results


def references(element: Element, path: str) -> tuple[int, ...]:
    """Return the ids to which the elements at a path refer."""
    return tuple(int(one.get("ref", "")) for one in element.iterfind(path))


def number_at(
    element: Element,
    path: str,
    largest: float = LARGEST_NUMBERS.coordinate,
    default: float | None = None,
) -> float:
    """Return the number at a path of tags, or the default where there is no element.

    Raises:
        ValueError: for a number that is not from ``-largest`` to ``largest``.
    """
    text = element.findtext(path)
    if text is None and default is not None:
        return default
    try:
        number = float(text or "")
    except ValueError:
        number = np.nan
    if not abs(number) <= largest:  # also if it is no number
        raise ValueError(
            f"<{path}> of <{element.tag}> is {text!r:.40}; it must be from"
            f" {-largest:g} to {largest:g}"
        )
    return number


def interval_at(element: Element, tag: str, largest: float) -> tuple[float, float]:
    """Return both ends of an interval; of an exact value, return it twice."""
    if element.find(f"{tag}/exact") is not None:
        exact = number_at(element, f"{tag}/exact", largest)
        return exact, exact
    first = number_at(element, f"{tag}/intervalStart", largest)
    last = number_at(element, f"{tag}/intervalEnd", largest)
    if first > last:
        raise ValueError(f"<{tag}> of a goal ends before it begins")
    return first, last


def points_at(element: Element, path: str) -> Points:
    """Return the points at a path of tags, an empty array without any."""
    points = [
        (number_at(point, "x"), number_at(point, "y"))
        for point in element.iterfind(path)
    ]
    return np.array(points).reshape(-1, 2)


def outlines_at(element: Element, path: str = "shape/*") -> list[Points]:
    """Return the corners of each shape at a path of tags."""
    outlines = [_outline(shape) for shape in element.iterfind(path)]
    if not outlines:
        raise ValueError(f"<{element.tag}> lacks a shape")
    return outlines


def turned_left(vectors: Points, angle: Numeric) -> Points:
    """Return vectors turned to the left by an angle, or each by its own [rad]."""
    return np.stack(rotated(vectors[..., 0], vectors[..., 1], -angle), axis=-1)


def _outline(shape: Element) -> Points:
    """Return the corners of a rectangle or polygon, or of one in place of a circle."""
    if shape.tag == "polygon":
        corners = points_at(shape, "point")
    elif shape.tag == "circle":
        corners = _circle(shape)
    elif shape.tag == "rectangle":
        corners = _rectangle(shape)
    else:
        raise ValueError(
            f"<{shape.tag}> is none of the shapes that can be read: rectangle, circle"
            " and polygon"
        )
    if len(corners) < 3 or not np.ptp(corners, axis=0).all():
        raise ValueError(f"<{shape.tag}> has no area")
    centre = [number_at(shape, f"center/{axis}", default=0.0) for axis in "xy"]
    return corners + centre


def _circle(shape: Element) -> Points:
    """Return the corners of a regular polygon of 64 corners in place of a circle."""
    angles = 2 * np.pi / 64 * np.arange(64)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return number_at(shape, "radius") * directions


def _rectangle(shape: Element) -> Points:
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    corners = square * [number_at(shape, "length"), number_at(shape, "width")]
    corners[:, 0] -= number_at(shape, "originXShift", default=0.0)
    angle = number_at(shape, "orientation", LARGEST_NUMBERS.angle, default=0.0)
    return turned_left(corners, angle)
