"""The road from above, in figures: lanes, and cars as outlines. y points to the right, so that the left is up."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from ms_highway.game.arrays import Car
from ms_highway.runtime.arrays import Vector

GROUND, EDGE, MARKING = "#f1f2f4", "#555b66", "#b4b9c2"


def draw_road(axes: Axes, lanes: Vector, lane_width: float, stretch: tuple[float, float]) -> None:
    """Draw a stretch of straight road, at one scale along and across, with a tick at every lane's centre.

    Args:
        axes: where.
        lanes: lateral position of each lane's centre [m], ascending.
        lane_width: width of a lane [m]; the road ends half of it beyond the outermost centres.
        stretch: which part of the road to show, from and to [m].
    """
    left, right = lanes[0] - lane_width / 2, lanes[-1] + lane_width / 2
    axes.axhspan(left, right, color=GROUND, zorder=0)
    for edge in (left, right):
        axes.axhline(edge, color=EDGE, linewidth=1.2, zorder=1)
    for edge in (lanes[1:] + lanes[:-1]) / 2:
        axes.axhline(edge, color=MARKING, linewidth=0.8, linestyle=(0, (8, 8)), zorder=1)
    axes.set(xlim=stretch, ylim=(right + lane_width / 2, left - lane_width / 2))
    axes.set_aspect("equal", adjustable="box")
    axes.set_yticks(lanes, [f"{round(y, 1) + 0.0:.1f}" for y in lanes], fontsize="x-small")


def car_outline(state: Car, size: Vector, **style: Any) -> Rectangle:
    """Return the outline of a car seen from above, to be added to axes.

    Args:
        state: ``(x, y, heading, speed)`` in metres, radians and metres per second.
        size: length and width [m].
        style: of the outline, see ``matplotlib.patches.Rectangle``.
    """
    (x, y, heading, _), (length, width) = map(float, state), map(float, size)
    corner = x - length / 2, y - width / 2
    return Rectangle(corner, length, width, angle=np.degrees(heading), rotation_point="center", **style)
