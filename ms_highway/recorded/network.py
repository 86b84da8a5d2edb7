"""Turn lanelets into a road network of highway-env.

Its lanes are smooth, have their own widths, merge, branch and end.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, compress
from typing import ClassVar, NamedTuple

import numpy as np
from highway_env.road.lane import AbstractLane, LineType
from highway_env.road.road import LaneIndex, RoadNetwork
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.interpolate import make_smoothing_spline

from ms_highway.geometry.curve import Curve, arc_lengths, resample, wrapped
from ms_highway.recorded.scenario import Lanelet, Points, TrafficRecording
from ms_highway.runtime.arrays import Numbers, State

Values = Float[np.ndarray, "n"]


@dataclass(frozen=True)
class LaneSmoothing:
    """Set how lanelets are smoothed.

    Lines of maps have kinks that would look like steering.
    """

    scales: tuple[float, ...] = (10.0, 5.0, 2.5, 1.25, 0.625)
    """Waves shorter than 2 pi times a scale are smoothed away, at first about 60 m [m].
    The next scale is tried where a lane would leave its lanelet.
    """
    max_deviation: float = 0.1
    """Largest distance from the middle of a lanelet to the middle of its lane [m]."""
    neighbour_length: float = 60.0
    """Length of the lanes before and after a lane with which it is smoothed [m]."""
    curve_spacing: float = 0.5
    """Distance between the samples of a curve [m]."""
    lane_spacing: float = 1.0
    """Distance between the samples of a lane [m]."""
    min_points: int = 5
    """Number of points for which a smoothing spline can be fitted."""


LANE_SMOOTHING = LaneSmoothing()


class Axes(NamedTuple):
    """Convert between the axes of a map and highway-env's.

    In the map, y is to the left of x; in highway-env, x is along the road and y to its
    right.

    Attributes:
        origin: of highway-env's axes in the map [m]; near the road, because single
            precision resolves little far away.
        turn: direction of highway-env's x in the map [rad].
    """

    origin: Points
    turn: float

    @classmethod
    def of(cls, lanelets: Sequence[Lanelet]) -> "Axes":
        """Return axes along the mean direction of a road.

        Their origin is in its middle, at whole metres.
        """
        lines = [lanelet.centre for lanelet in lanelets]
        along_x, along_y = np.sum([line[-1] - line[0] for line in lines], axis=0)
        turn = float(np.arctan2(along_y, along_x))
        middle = np.concatenate(lines).mean(axis=0)
        return cls(np.round(middle), turn)

    def positions(self, points: ArrayLike) -> Points:
        """Return points of the map in highway-env's axes."""
        from_origin = np.asarray(points, dtype=float) - self.origin
        return from_origin @ self._mirror

    def points(self, positions: ArrayLike) -> Points:
        """Return positions of highway-env in the map."""
        from_origin = np.asarray(positions, dtype=float) @ self._mirror.T
        return from_origin + self.origin

    def headings(self, orientations: ArrayLike) -> Numbers:
        """Convert orientations in the map to highway-env's headings, or back [rad]."""
        return wrapped(self.turn - np.asarray(orientations, dtype=float))

    def states(self, samples: np.ndarray) -> State:
        """Return the states of a track [times, 4] in highway-env's axes.

        They are x, y, heading and speed, given samples [times, 5].
        """
        _, _, _, orientations, speeds = samples.T
        positions = self.positions(samples[:, 1:3])
        return np.column_stack([positions, self.headings(orientations), speeds])

    @property
    def _mirror(self) -> np.ndarray:
        """The matrix that turns the axes and reverses y; it is symmetric."""
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
        x, y, _ = self.curve.place(longitudinal, lateral)
        return np.array([x, y])

    def heading_at(self, longitudinal: float) -> float:
        """Return the heading at a place [rad]."""
        return float(self.curve.interpolate(self.curve.heading, longitudinal))

    def width_at(self, longitudinal: float) -> float:
        """Return the width at a place [m]."""
        return float(self.curve.interpolate(self.widths, longitudinal))

    def local_coordinates(self, position: np.ndarray) -> tuple[float, float]:
        """Return the place along the lane and the distance to the right of it [m]."""
        along, right = self.curve.locate(np.asarray(position))
        return float(along), float(right)


class LaneletNetwork(RoadNetwork):
    """A road network of sampled lanes.

    It measures the exact distance only to lanes that may be the closest one.
    """

    heading_allowance: ClassVar[float] = 5.0
    """Distance by which a lane may be farther away than the nearest one, and still be
    closer when headings count [m].
    """

    @cached_property
    def _samples(self) -> tuple[Points, Int[np.ndarray, "lanes"]]:
        """Centres of all lanes in a row, and the index of the first of each lane."""
        centres = [lane.centres for lane in self.lanes_list()]
        lengths = [len(line) for line in centres[:-1]]
        firsts = np.cumsum([0, *lengths])
        return np.concatenate(centres), firsts

    def get_closest_lane_index(
        self,
        position: np.ndarray,
        heading: float | None = None,
    ) -> LaneIndex:
        """Return the index of the lane that is nearest in position and heading."""
        samples, firsts = self._samples
        dx, dy = (samples - position).T
        to_samples = np.hypot(dx, dy)
        distances = np.minimum.reduceat(to_samples, firsts)  # [lanes]
        may_be_closest = distances < distances.min() + self.heading_allowance

        def exact_distance(index: LaneIndex) -> float:
            return self.get_lane(index).distance_with_heading(position, heading)

        candidates = compress(self.lanes_dict(), may_be_closest)
        return min(candidates, key=exact_distance)


def network_of(lanelets: Sequence[Lanelet], axes: Axes) -> RoadNetwork:
    """Build the road network of a recording.

    Lanelets side by side are the lanes of one road, from the left.

    Raises:
        ValueError: for a lanelet that is beside itself, two roads between the same
            places, or too sharp a turn.
    """
    by_number = {lanelet.number: lanelet for lanelet in lanelets}
    network = LaneletNetwork()
    roads = list(_roads(by_number))
    for road, (start, end) in zip(roads, _nodes(roads), strict=True):
        if end in network.graph.get(start, {}):
            raise ValueError(
                f"lanelet {road[0].number} begins and ends where another road does, but"
                " is not beside it; such roads cannot be driven here"
            )
        for lanelet in road:
            left = LineType.STRIPED
            right = LineType.NONE
            if lanelet is road[0]:
                left = LineType.CONTINUOUS_LINE
            if lanelet is road[-1]:
                right = LineType.CONTINUOUS_LINE
            lane = _lane(lanelet, by_number, axes, (left, right))
            network.add_lane(start, end, lane)
    return network


def _roads(by_number: Mapping[int, Lanelet]) -> Iterator[list[Lanelet]]:
    """Yield the lanelets of each road, from the left."""
    on_roads = set[int]()
    for lanelet in by_number.values():
        if lanelet.number not in on_roads:
            road = _road_of(lanelet, by_number)
            on_roads |= {other.number for other in road}
            yield road


def _road_of(lanelet: Lanelet, by_number: Mapping[int, Lanelet]) -> list[Lanelet]:
    """Return a lanelet and all that are beside it, from the left.

    Raises:
        ValueError: for a lanelet that is beside itself.
    """
    road = [lanelet]
    left, _ = lanelet.beside
    while left is not None and left in by_number:
        _check_new(left, road)
        road.insert(0, by_number[left])
        left, _ = road[0].beside
    _, right = lanelet.beside
    while right is not None and right in by_number:
        _check_new(right, road)
        road.append(by_number[right])
        _, right = road[-1].beside
    return road


def _check_new(number: int, road: Sequence[Lanelet]) -> None:
    """Raise an error if a lanelet is already among those of a road."""
    if any(other.number == number for other in road):
        raise ValueError(
            f"lanelet {number} is beside itself; mend the file or leave it out"
        )


def _nodes(roads: Sequence[list[Lanelet]]) -> list[list[str]]:
    """Return the names of the nodes at which each road begins and ends.

    Roads whose lanelets meet share a node.
    """
    road_of = {}  # index of each lanelet's road
    for index, road in enumerate(roads):
        for lanelet in road:
            road_of[lanelet.number] = index

    nodes = np.arange(2 * len(roads)).reshape(-1, 2)  # start and end of each road
    for lanelet in chain(*roads):
        _, end = nodes[road_of[lanelet.number]]
        for after in road_of.keys() & set(lanelet.after):
            start_after, _ = nodes[road_of[after]]
            nodes[nodes == start_after] = end
    return nodes.astype(str).tolist()


def _lane(
    lanelet: Lanelet,
    by_number: Mapping[int, Lanelet],
    axes: Axes,
    edges: Sequence[int],
) -> SampledLane:
    """Return the lane of a lanelet along its smoothed centre.

    If possible, it is smoothed with the lanes before and after it.

    Args:
        lanelet: of the lane.
        by_number: all lanelets.
        axes: of highway-env.
        edges: types of the lines at the left and the right edge.

    Raises:
        ValueError: if every smooth lane is too far from the centre.
    """
    # The centre, with parts of the lanelets before and after it.
    centre = lanelet.centre
    lines = [centre]
    for number in lanelet.before[:1]:
        if number in by_number:
            lines.insert(0, _last_part(by_number[number].centre))
    for number in lanelet.after[:1]:
        if number in by_number:
            backwards = by_number[number].centre[::-1]
            lines.append(_last_part(backwards)[::-1])
    with_neighbours = np.concatenate(lines)

    # The first curve that is near the centre.
    even_points = resample(centre.T, LANE_SMOOTHING.lane_spacing).T
    even_centre = axes.positions(even_points)
    deviation = np.inf
    for curve in chain(smooth_curves(with_neighbours), smooth_curves(centre)):
        lane = _lane_along(curve, lanelet, axes, edges)
        deviation = _deviation(even_centre, lane)
        if deviation <= LANE_SMOOTHING.max_deviation:
            return lane
    raise ValueError(
        f"lanelet {lanelet.number} turns too sharply: the middle of a smooth lane would"
        f" be {deviation:.2f} m off its own"
    )


def _lane_along(
    curve: Curve,
    lanelet: Lanelet,
    axes: Axes,
    edges: Sequence[int],
) -> SampledLane:
    """Return the lane of a lanelet along a curve of the map."""
    # Even places on the part of the curve that belongs to the lanelet.
    along, _ = curve.locate(lanelet.centre)
    length = along[-1] - along[0]
    parts = max(round(length / LANE_SMOOTHING.lane_spacing), 2)
    places = np.linspace(along[0], along[-1], parts + 1)

    # The lane's middle and width at these places.
    x, y, _ = curve.place(places, 0.0)
    middle = axes.positions(np.stack([x, y], axis=-1))
    recorded_widths = np.linalg.norm(lanelet.left - lanelet.right, axis=-1)
    ascending = np.maximum.accumulate(along)
    widths = np.interp(places, ascending, recorded_widths)
    limit = lanelet.limit or TrafficRecording.default_speed_limit
    return SampledLane(middle, widths, edges, limit)


def _deviation(line: Points, lane: SampledLane) -> float:
    """Return how far a line is at most from a lane's middle or beyond its ends [m]."""
    along, offset = lane.curve.locate(line)
    before_start = -along.min()
    beyond_end = along.max() - lane.length
    return max(np.abs(offset).max(), before_start, beyond_end)


def smooth_curves(line: Points) -> Iterator[Curve]:
    """Yield curves along a line, the smoothest first; see `LaneSmoothing`."""
    is_new_point = np.any(np.diff(line, axis=0) != 0, axis=-1)
    line = line[np.r_[True, is_new_point]]
    distance = arc_lengths(line.T)
    length = distance[-1]
    for scale in LANE_SMOOTHING.scales:
        # A smoothing spline through evenly spaced points of the line.
        spacing = scale / 2
        number = max(round(length / spacing) + 1, LANE_SMOOTHING.min_points)
        even = np.linspace(0, length, number)
        fields = [np.interp(even, distance, field) for field in line.T]
        points = np.stack(fields, axis=-1)
        spline = make_smoothing_spline(even, points, lam=scale**4 / spacing)

        # A curve through evenly spaced points of the spline.
        step = min(LANE_SMOOTHING.curve_spacing, length / LANE_SMOOTHING.min_points)
        fine = spline(np.arange(0.0, length + step, step / 2))
        x, y = resample(fine.T, step)
        yield Curve.through(x, y, spacing=step)


def _last_part(line: Points) -> Points:
    """Return the last points of a line with which a neighbour is smoothed.

    They are at least two.
    """
    to_end = arc_lengths(line[::-1].T)[::-1]
    is_near = to_end <= LANE_SMOOTHING.neighbour_length
    return line[is_near] if is_near.sum() > 1 else line[-2:]
