"""Turn lanelets into a road network of highway-env: smooth lanes with their own widths,
which merge, branch and end.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain, compress
from typing import Any, NamedTuple

import numpy as np
from highway_env.road.lane import AbstractLane, LineType
from highway_env.road.road import LaneIndex, RoadNetwork
from jaxtyping import Float
from scipy.interpolate import make_smoothing_spline

from ms_highway.geometry.curve import Curve, arc_lengths, resample, wrapped
from ms_highway.recorded.scenario import SPEED_LIMIT, Lanelet, Points
from ms_highway.runtime.arrays import State

Values = Float[np.ndarray, "n"]

STEP = 1.0  # m, between samples of a lane
SPACING = 0.5  # m, between samples of curves
SMOOTHED = (
    10.0,
    5.0,
    2.5,
    1.25,
    0.625,
)  # m; waves shorter than 2 pi times this, at first about 60 m, are smoothed away
MIN_POINTS = 5  # for which a smoothing spline can be fitted
BRIDGED = 60.0  # m of the lanes before and after a lane with which it is smoothed
# m, by which a lane may be farther away than the nearest one, and be closer counting
# the heading
CLOSE = 5.0
WITHIN = (
    0.1  # m, largest distance from the middle of a lanelet to the middle of its lane
)


class Axes(NamedTuple):
    """Convert between the axes of a map, with y to the left of x, and highway-env's,
    with x along the road.

    Attributes:
        origin: of highway-env's axes in the map [m]; near the road, because single
            precision resolves little far away.
        turn: direction of highway-env's x in the map [rad].
    """

    origin: Points
    turn: float

    @classmethod
    def of(cls, lanelets: Sequence[Lanelet]) -> "Axes":
        """Return axes along the mean direction of a road, with their origin in its
        middle, at whole metres.
        """
        lines = [lanelet.centre for lanelet in lanelets]
        along = np.sum([line[-1] - line[0] for line in lines], axis=0)
        return cls(
            np.round(np.concatenate(lines).mean(axis=0)),
            float(np.arctan2(along[1], along[0])),
        )

    def positions(self, points: Any) -> Points:
        """Return points of the map in highway-env's axes."""
        return (np.asarray(points, dtype=float) - self.origin) @ self._mirror

    def points(self, positions: Any) -> Points:
        """Return positions of highway-env in the map."""
        return np.asarray(positions, dtype=float) @ self._mirror.T + self.origin

    def headings(self, orientations: Any) -> Any:
        """Convert orientations in the map to headings in highway-env's axes, or
        headings to orientations [rad].
        """
        return wrapped(self.turn - np.asarray(orientations, dtype=float))

    def states(self, samples: np.ndarray) -> State:
        """Return x, y, heading and speed in highway-env's axes, given samples of a
        track [times, 5].
        """
        _, _, _, orientations, speeds = samples.T
        return np.column_stack(
            [self.positions(samples[:, 1:3]), self.headings(orientations), speeds]
        )

    @property
    def _mirror(self) -> np.ndarray:
        cosine = np.cos(self.turn)
        sine = np.sin(self.turn)
        return np.array([[cosine, sine], [sine, -cosine]])


class SampledLane(AbstractLane):
    """A lane along a smooth curve; it goes straight on beyond its ends.

    Args:
        centres: positions of its middle, evenly spaced [points, 2].
        widths: at these positions [m].
        line_types: highway-env's types of its left and its right edge.
        speed_limit: [m/s].
    """

    def __init__(
        self,
        centres: Points,
        widths: Values,
        line_types: Sequence[int],
        speed_limit: float,
    ) -> None:
        self.centres = centres
        self.widths = widths
        x, y = centres.T
        spacing = np.hypot(np.diff(x), np.diff(y)).mean()
        self.curve = Curve.through(x, y, spacing=float(spacing))
        self.length = float(self.curve.end)
        self.speed_limit = speed_limit
        self.line_types = line_types
        self.forbidden = False
        self.priority = 0

    def position(self, longitudinal: float, lateral: float) -> np.ndarray:
        """Return the position at lane coordinates [m]."""
        return np.array(self.curve.place(longitudinal, lateral)[:2])

    def heading_at(self, longitudinal: float) -> float:
        """Return the heading at a place [rad]."""
        return float(self.curve.interpolate(self.curve.heading, longitudinal))

    def width_at(self, longitudinal: float) -> float:
        """Return the width at a place [m]."""
        return float(self.curve.interpolate(self.widths, longitudinal))

    def local_coordinates(self, position: np.ndarray) -> tuple[float, float]:
        """Return the place along the lane and the distance to the right of its middle
        [m].
        """
        along, right = self.curve.locate(np.asarray(position))
        return float(along), float(right)


class LaneletNetwork(RoadNetwork):
    """A road network of sampled lanes that measures the exact distance only to lanes
    that may be the closest one.
    """

    @cached_property
    def _samples(self) -> tuple[Points, np.ndarray]:
        """Centres of all lanes, one lane after the other, and the index of the first
        one of each lane.
        """
        centres = [lane.centres for lane in self.lanes_list()]
        return np.concatenate(centres), np.cumsum([0, *map(len, centres[:-1])])

    def get_closest_lane_index(
        self, position: np.ndarray, heading: float | None = None
    ) -> LaneIndex:
        """Return the index of the lane that is nearest in position and heading."""
        samples, firsts = self._samples
        distances = np.minimum.reduceat(np.hypot(*(samples - position).T), firsts)
        close = distances < distances.min() + CLOSE
        near = compress(self.lanes_dict(), close)
        return min(
            near,
            key=lambda index: self.get_lane(index).distance_with_heading(
                position, heading
            ),
        )


def network_of(lanelets: Sequence[Lanelet], axes: Axes) -> RoadNetwork:
    """Build the road network of a recording: lanelets side by side are the lanes of one
    road, from the left.

    Raises:
        ValueError: for a lanelet that is beside itself, two roads between the same
            places, or too sharp a turn.
    """
    known = {lanelet.number: lanelet for lanelet in lanelets}
    network = LaneletNetwork()
    roads = [*_roads(known)]
    for road, (start, end) in zip(roads, _nodes(roads), strict=True):
        if end in network.graph.get(start, {}):
            raise ValueError(
                f"lanelet {road[0].number} begins and ends where another road does, but"
                " is not beside it; such roads cannot be driven here"
            )
        for place, lanelet in enumerate(road):
            left = LineType.STRIPED if place else LineType.CONTINUOUS_LINE
            right = (
                LineType.NONE if lanelet is not road[-1] else LineType.CONTINUOUS_LINE
            )
            network.add_lane(start, end, _lane(lanelet, known, axes, [left, right]))
    return network


def _roads(known: dict[int, Lanelet]) -> Iterator[list[Lanelet]]:
    """Yield the lanelets of each road, from the left."""
    placed = set[int]()
    for lanelet in known.values():
        if lanelet.number in placed:
            continue
        road = [lanelet]
        for side in (0, 1):
            while (beside := road[-side].beside[side]) in known:
                if beside in (other.number for other in road):
                    raise ValueError(
                        f"lanelet {beside} is beside itself; mend the file or leave"
                        " it out"
                    )
                road.insert(side * len(road), known[beside])
        placed |= {other.number for other in road}
        yield road


def _nodes(roads: list[list[Lanelet]]) -> list[list[str]]:
    """Return the names of the nodes at which each road begins and ends; roads whose
    lanelets meet share a node.
    """
    number = {
        lanelet.number: road
        for road, lanelets in enumerate(roads)
        for lanelet in lanelets
    }
    nodes = np.arange(2 * len(roads)).reshape(-1, 2)
    for lanelet in chain(*roads):
        for after in number.keys() & set(lanelet.after):
            nodes[nodes == nodes[number[after], 0]] = nodes[number[lanelet.number], 1]
    return nodes.astype(str).tolist()


def _lane(
    lanelet: Lanelet, known: dict[int, Lanelet], axes: Axes, lines: Sequence[int]
) -> SampledLane:
    """Return the lane of a lanelet along its smoothed centre, if possible smoothed with
    the lanes before and after it.

    Raises:
        ValueError: if every smooth lane is too far from the centre.
    """
    centre = lanelet.centre
    before = [
        _last(known[number].centre) for number in lanelet.before[:1] if number in known
    ]
    after = [
        _last(known[number].centre[::-1])[::-1]
        for number in lanelet.after[:1]
        if number in known
    ]
    for smooth in chain(fits(np.concatenate([*before, centre, *after])), fits(centre)):
        along, _ = smooth.locate(centre)
        places = np.linspace(
            along[0], along[-1], max(round((along[-1] - along[0]) / STEP), 2) + 1
        )
        widths = np.interp(
            places,
            np.maximum.accumulate(along),
            np.linalg.norm(lanelet.left - lanelet.right, axis=-1),
        )
        middle = axes.positions(np.stack(smooth.place(places, 0.0)[:2], axis=-1))
        lane = SampledLane(middle, widths, lines, lanelet.limit or SPEED_LIMIT)
        along, aside = lane.curve.locate(axes.positions(resample(centre.T, STEP).T))
        off = max(np.abs(aside).max(), -along.min(), along.max() - lane.length)
        if off <= WITHIN:
            return lane
    raise ValueError(
        f"lanelet {lanelet.number} turns too sharply: the middle of a smooth lane would"
        f" be {off:.2f} m off its own"
    )


def fits(line: Points) -> Iterator[Curve]:
    """Yield curves along a line, the smoothest first: lines of maps have kinks that
    would look like steering.
    """
    line = line[np.r_[True, np.any(np.diff(line, axis=0) != 0, axis=-1)]]
    distance = arc_lengths(line.T)
    for smoothed in SMOOTHED:
        spacing = smoothed / 2
        even = np.linspace(
            0, distance[-1], max(round(distance[-1] / spacing) + 1, MIN_POINTS)
        )
        points = np.stack([np.interp(even, distance, part) for part in line.T], axis=-1)
        smooth = make_smoothing_spline(even, points, lam=smoothed**4 / spacing)
        step = min(SPACING, distance[-1] / MIN_POINTS)
        x, y = resample(smooth(np.arange(0.0, distance[-1] + step, step / 2)).T, step)
        yield Curve.through(x, y, spacing=step)


def _last(line: Points) -> Points:
    """Return the last points of a line, over the length `BRIDGED` and at least two."""
    left = arc_lengths(line[::-1].T)[::-1]
    return line[left <= BRIDGED] if (left <= BRIDGED).sum() > 1 else line[-2:]
