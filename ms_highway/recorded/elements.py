"""Read numbers and shapes from the XML elements of CommonRoad files; an error names the element and what it lacks."""

from collections.abc import Callable
from typing import Any, TypeVar
from xml.etree.ElementTree import Element

import numpy as np

from ms_highway.geometry.curve import rotated
from ms_highway.recorded.scenario import Points

CIRCLE = 64  # corners of the polygon that a circle is read as
FARTHEST = 1e8  # m, of coordinates
MOST_RADIANS = 1000.0  # of an orientation

Read = TypeVar("Read")


def each(root: Element, tag: str, read: Callable[[int, Element], Read]) -> list[Read]:
    """Apply ``read`` to the id and the element of all elements with a tag.

    Raises:
        ValueError: naming the element, if it has no id of its own, or cannot be read.
    """
    found: dict[int, Read] = {}
    for element in root.iterfind(tag):
        identity = attribute(element, "id")
        try:
            if identity in found:
                raise ValueError("it has the id of another one")
            found[identity] = read(identity, element)
        except ValueError as error:
            raise ValueError(f"{tag} {identity}: {error}") from error
    return list(found.values())


def attribute(element: Element, name: str, kind: Callable[[str], Any] = int) -> Any:
    """Return a number that is an attribute of an element, by default an integer.

    Raises:
        ValueError: if it is missing, or no number.
    """
    text = element.get(name, "")
    try:
        return kind(text)
    except ValueError as error:
        raise ValueError(f"{name} of <{element.tag}> is {text!r:.40}; it must be a number") from error


def references(element: Element, tag: str) -> tuple[int, ...]:
    """Return the ids that the elements with a tag refer to."""
    return tuple(attribute(one, "ref") for one in element.iterfind(tag))


def child(element: Element, tag: str) -> Element:
    """Return the element with a tag.

    Raises:
        ValueError: if there is none.
    """
    found = element.find(tag)
    if found is None:
        raise ValueError(f"<{element.tag}> lacks <{tag}>")
    return found


def number(
    element: Element, path: str, least: float = -FARTHEST, most: float = FARTHEST, default: float | None = None
) -> float:
    """Return the number at a path of tags below an element, or the default if there is none.

    Raises:
        ValueError: naming the path, if the number is missing, an interval, no number, or out of range.
    """
    text = element.findtext(path)
    if text is None:
        if default is None:
            raise ValueError(f"<{element.tag}> lacks <{path}>")
        return default
    try:
        found = float(text)
    except ValueError:
        found = np.nan
    if not least <= found <= most:
        raise ValueError(f"<{path}> of <{element.tag}> is {text!r:.40}; it must be from {least:g} to {most:g}")
    return found


def interval(element: Element, tag: str, least: float, most: float) -> tuple[float, float] | None:
    """Return both ends of an interval, an exact value twice, or None without the element."""
    part = element.find(tag)
    if part is None:
        return None
    ends = ("intervalStart", "intervalEnd") if part.find("exact") is None else ("exact", "exact")
    first, last = (number(part, end, least, most) for end in ends)
    if first > last:
        raise ValueError(f"<{tag}> of a goal ends before it begins")
    return first, last


def pose(state: Element) -> tuple[float, float, float]:
    """Return x, y and orientation of a state."""
    x, y = (number(state, f"position/point/{axis}") for axis in "xy")
    return x, y, number(state, "orientation/exact", -MOST_RADIANS, MOST_RADIANS)


def points(element: Element) -> Points:
    """Return the points of a line."""
    return np.array([[number(point, axis) for axis in "xy"] for point in element.iterfind("point")]).reshape(-1, 2)


def outlines(shape: Element) -> list[Points]:
    """Return the corners of each shape of an element.

    Raises:
        ValueError: if there is none, or one of an unknown kind, or without an area.
    """
    found = [_outline(piece) for piece in shape]
    if not found:
        raise ValueError(f"<{shape.tag}> lacks a shape")
    return found


def _outline(piece: Element) -> Points:
    if piece.tag == "polygon":
        corners = points(piece)
    elif piece.tag == "circle":
        angles = 2 * np.pi / CIRCLE * np.arange(CIRCLE)
        corners = number(piece, "radius", 0) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    elif piece.tag in ("rectangle", "truckShape"):
        sides = piece if piece.tag == "rectangle" else child(piece, "truckDims")
        length, width = (number(sides, name, 0) for name in ("length", "width"))
        corners = np.array([[-length, -width], [length, -width], [length, width], [-length, width]]) / 2
        corners[:, 0] -= number(piece, "originXShift", default=0.0 if piece is sides else None)
        corners = turned(corners, number(piece, "orientation", -MOST_RADIANS, MOST_RADIANS, default=0.0))
    else:
        raise ValueError(f"<{piece.tag}> is no shape that can be read: rectangle, circle, polygon or truckShape")
    if len(corners) < 3 or not np.ptp(corners, axis=0).all():
        raise ValueError(f"<{piece.tag}> has no area")
    return corners + [number(piece, f"center/{axis}", default=0.0) for axis in "xy"]


def box(corners: Points, turn: float = 0.0) -> tuple[tuple[float, float], Points]:
    """Return length, width and centre of the box around points, its length along a direction [rad]."""
    along = turned(corners, -turn)
    low, high = along.min(axis=0), along.max(axis=0)
    length, width = (high - low).tolist()
    return (length, width), turned((low + high) / 2, turn)


def turned(vectors: Points, angle: Any) -> Points:
    """Return vectors turned to the left."""
    return np.stack(rotated(vectors[..., 0], vectors[..., 1], -angle), axis=-1)
