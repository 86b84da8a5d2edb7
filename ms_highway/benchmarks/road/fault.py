"""Whose fault a collision is."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import cos
from typing import Any

import numpy as np

__all__ = ["Place", "is_at_fault"]

OFFSET = 1.0  # m
STANDING = 1.0  # m/s
SAME_WAY = 0.7  # cosine of the angle between two headings, at least


@dataclass(frozen=True)
class Place:
    """Where a car is on the road in one frame.

    Attributes:
        lane_index: of the closest lane.
        offset: from the centre of that lane [m].
        speed: [m/s].
        on_road: whether its centre is in that lane, or so close that it may be where two roads meet.
    """

    lane_index: tuple[str, str, int]
    offset: float
    speed: float
    on_road: bool


def is_at_fault(ego: Any, other: Any | None, places: Sequence[Place]) -> bool:
    """Return whether the ego is at fault in a collision; it is, unless it was rear-ended while keeping its lane.

    It was rear-ended if all of this holds:

    * the other goes the same way, within about 45 degrees;
    * the ego's centre is ahead of the other's front, along the other's heading;
    * the point of the other that is closest to the ego's centre is behind that centre, along the ego's heading.

    It kept its lane if, in all of ``places``, it was within 1 m of its lane's centre and faster than 1 m/s, and its
    number of the lane did not change while the road was the same. A car that stands on the road when it is hit is thus
    at fault, as is one that was pushed out of the way by a crash in its side.

    Args:
        ego: a vehicle of highway-env.
        other: the vehicle or object that it touches, None if that is not known.
        places: of the ego in the last second before the collision.
    """
    return other is None or not (_is_rear_ended(ego, other) and _keeps_lane(places))


def _is_rear_ended(ego: Any, other: Any) -> bool:
    if cos(ego.heading - other.heading) < SAME_WAY:
        return False
    across = np.array([-other.direction[1], other.direction[0]])
    away = ego.position - other.position
    forward, half_length, half_width = away @ other.direction, other.LENGTH / 2, other.WIDTH / 2
    closest = half_length * other.direction + np.clip(away @ across, -half_width, half_width) * across
    return bool(forward > half_length and (closest - away) @ ego.direction < 0)


def _keeps_lane(places: Sequence[Place]) -> bool:
    changed = any(
        before.lane_index[:2] == after.lane_index[:2] and before.lane_index[2] != after.lane_index[2]
        for before, after in pairwise(places)
    )
    return not changed and all(abs(place.offset) < OFFSET and place.speed > STANDING for place in places)
