"""Turn lanelets into a road network of highway-env: smooth lanes of their own widths that merge, branch and end."""

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from highway_env.road.lane import AbstractLane, LineType
from highway_env.road.road import LaneIndex, RoadNetwork
from highway_env.utils import get_class_path
from jaxtyping import Float
from scipy.interpolate import make_smoothing_spline

from ms_highway.geometry.curve import Curve, arc_lengths, resample, wrapped
from ms_highway.recorded.scenario import SPEED_LIMIT, Lanelet, Points

Values = Float[np.ndarray, "n"]

STEP = 1.0  # m, between samples of a lane
SPACING = 0.5  # m, between samples of curves
SMOOTHED = 10.0, 5.0, 2.5, 1.25, 0.625  # m; waves shorter than 2 pi times that, at first about 60 m, are smoothed
MIN_POINTS = 5  # that a smoothing spline can be fitted to
BRIDGED = 60.0  # m of the lanes before and after, by which a lane goes on smoothly
CLOSE = 5.0  # m, by which a lane may be farther than another, and nearer in position and heading
WITHIN = 0.1  # m, from the middle of a lanelet to that of its lane


class Axes(NamedTuple):
    """highway-env's axes, x along the road and y to its right, in those of a map, with y to the left of x.

    Attributes:
        origin: of highway-env's axes in those of the map [m]; near the road, as single precision resolves little far
            away.
        turn: direction of highway-env's x in the map [rad].
    """

    origin: Points
    turn: float

    @classmethod
    def of(cls, lanelets: Sequence[Lanelet]) -> "Axes":
        """Return axes with their origin in the middle of a road, at whole metres, that go along it in the mean."""
        lines = [lanelet.centre for lanelet in lanelets]
        along = np.sum([line[-1] - line[0] for line in lines], axis=0)
        return cls(np.round(np.concatenate(lines).mean(axis=0)), float(np.arctan2(along[1], along[0])))

    def positions(self, points: Any) -> Points:
        """Return points of the map in highway-env's axes."""
        return (np.asarray(points, dtype=float) - self.origin) @ self._mirror

    def points(self, positions: Any) -> Points:
        """Return positions of highway-env in the map."""
        return np.asarray(positions, dtype=float) @ self._mirror.T + self.origin

    def headings(self, orientations: Any) -> Any:
        """Return headings in highway-env's axes, of orientations in the map [rad]; or orientations, of headings."""
        return wrapped(self.turn - np.asarray(orientations, dtype=float))

    def pose(self, x: float, y: float, orientation: float) -> tuple[np.ndarray, float]:
        """Return position and heading in highway-env's axes, of a point and an orientation in the map."""
        return self.positions([x, y]), float(self.headings(orientation))

    @property
    def _mirror(self) -> np.ndarray:
        cosine, sine = np.cos(self.turn), np.sin(self.turn)
        return np.array([[cosine, sine], [sine, -cosine]])


class SampledLane(AbstractLane):
    """A lane along a smooth curve, straight on beyond its ends.

    Attributes:
        length: [m].
        speed_limit: [m/s].
    """

    def __init__(self, centres: Points, widths: Values, line_types: Sequence[int], speed_limit: float) -> None:
        """Make a lane.

        Args:
            centres: positions, evenly spaced [points, 2].
            widths: at these [m].
            line_types: of its left and its right edge, highway-env's.
            speed_limit: [m/s].
        """
        self.centres, self.widths = np.asarray(centres, dtype=float), np.asarray(widths, dtype=float)  # JSON has lists
        spacing = np.hypot(*np.diff(self.centres, axis=0).T).mean()
        x, y = self.centres.T
        self.curve = Curve.through(x, y, spacing=float(spacing))
        self.length, self.speed_limit = float(self.curve.end), speed_limit
        self.line_types, self.forbidden, self.priority = list(line_types), False, 0

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
        """Return the place along the lane and the distance to the right of its middle [m]."""
        along, right = self.curve.locate(np.asarray(position))
        return float(along), float(right)

    @classmethod
    def from_config(cls, config: dict) -> "SampledLane":
        """Return the lane that ``config`` of `to_config` describes."""
        return cls(**config)

    def to_config(self) -> dict:
        """Return what describes the lane, for JSON."""
        config = {
            "centres": self.centres.tolist(),
            "widths": self.widths.tolist(),
            "line_types": self.line_types,
            "speed_limit": self.speed_limit,
        }
        return {"class_path": get_class_path(self.__class__), "config": config}


class LaneletNetwork(RoadNetwork):
    """A road network of sampled lanes that measures the distance only to lanes that may be the closest one."""

    @cached_property
    def _samples(self) -> tuple[Points, list[int]]:
        """Centres of all lanes, one after the other, and where each lane's begin."""
        centres = [lane.centres for lane in self.lanes_list()]
        return np.concatenate(centres), [0, *np.cumsum([len(lane) for lane in centres[:-1]]).tolist()]

    def get_closest_lane_index(self, position: np.ndarray, heading: float | None = None) -> LaneIndex:
        """Return the index of the lane that is nearest in position and heading."""
        samples, firsts = self._samples
        distances = np.minimum.reduceat(np.hypot(*(samples - position).T), firsts)
        close = distances < distances.min() + CLOSE
        near = [index for index, is_near in zip(self.lanes_dict(), close, strict=True) if is_near]
        return min(near, key=lambda index: self.get_lane(index).distance_with_heading(position, heading))


def network_of(lanelets: Sequence[Lanelet], axes: Axes) -> RoadNetwork:
    """Build the road network of a recording: lanelets side by side are the lanes of a road, from the left.

    Raises:
        ValueError: for a lanelet that is beside itself, or roads that part and meet again.
    """
    known = {lanelet.number: lanelet for lanelet in lanelets}
    network, roads = LaneletNetwork(), [*_roads(known)]
    for road, (start, end) in zip(roads, _nodes(roads), strict=True):
        if end in network.graph.get(start, {}):
            raise ValueError(
                f"lanelet {road[0].number} leads from where another road begins to where that ends, but is not beside "
                "it; such roads cannot be driven here"
            )
        for place, lanelet in enumerate(road):
            left = LineType.STRIPED if place else LineType.CONTINUOUS_LINE
            right = LineType.NONE if lanelet is not road[-1] else LineType.CONTINUOUS_LINE
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
                    raise ValueError(f"lanelet {beside} is beside itself; mend the file or leave it out")
                road.insert(side * len(road), known[beside])
        placed |= {other.number for other in road}
        yield road


def _nodes(roads: list[list[Lanelet]]) -> list[list[str]]:
    """Return the names of the nodes at which each road begins and ends: one node where lanelets meet."""
    number = {lanelet.number: road for road, lanelets in enumerate(roads) for lanelet in lanelets}
    nodes = np.arange(2 * len(roads)).reshape(-1, 2)
    for lanelet in chain(*roads):
        for after in number.keys() & set(lanelet.after):
            nodes[nodes == nodes[number[after], 0]] = nodes[number[lanelet.number], 1]
    return nodes.astype(str).tolist()


def _lane(lanelet: Lanelet, known: dict[int, Lanelet], axes: Axes, lines: Sequence[int]) -> SampledLane:
    """Return the lane of a lanelet: its centre, smoothed, with the lanes before and after it if possible.

    Raises:
        ValueError: if every smooth lane is too far from the centre.
    """
    centre = lanelet.centre
    before = [_last(known[number].centre) for number in lanelet.before[:1] if number in known]
    after = [_last(known[number].centre[::-1])[::-1] for number in lanelet.after[:1] if number in known]
    for smooth in chain(fits(np.concatenate([*before, centre, *after])), fits(centre)):
        along, _ = smooth.locate(centre)
        places = np.linspace(along[0], along[-1], max(round((along[-1] - along[0]) / STEP), 2) + 1)
        widths = np.interp(places, np.maximum.accumulate(along), np.linalg.norm(lanelet.left - lanelet.right, axis=-1))
        lane = SampledLane(
            axes.positions(np.stack(smooth.place(places, 0.0)[:2], axis=-1)),
            widths,
            lines,
            lanelet.limit or SPEED_LIMIT,
        )
        along, aside = lane.curve.locate(axes.positions(resample(centre.T, STEP).T))
        off = max(np.abs(aside).max(), -along.min(), along.max() - lane.length)
        if off <= WITHIN:
            return lane
    raise ValueError(
        f"lanelet {lanelet.number} turns too sharply: the middle of a smooth lane would be {off:.2f} m off its own"
    )


def fits(line: Points) -> Iterator[Curve]:
    """Yield curves along a line, first smoothed much: lines of maps have kinks that would look like steering."""
    line = line[np.r_[True, np.any(np.diff(line, axis=0) != 0, axis=-1)]]
    distance = arc_lengths(line.T)
    for smoothed in SMOOTHED:
        spacing = smoothed / 2
        even = np.linspace(0, distance[-1], max(round(distance[-1] / spacing) + 1, MIN_POINTS))
        points = np.stack([np.interp(even, distance, part) for part in line.T], axis=-1)
        smooth = make_smoothing_spline(even, points, lam=smoothed**4 / spacing)
        step = min(SPACING, distance[-1] / MIN_POINTS)
        x, y = resample(smooth(np.arange(0.0, distance[-1] + step, step / 2)).T, step)
        yield Curve.through(x, y, spacing=step)


def _last(line: Points) -> Points:
    """Return the points of a line before its end that are to be bridged, at least two."""
    left = arc_lengths(line[::-1].T)[::-1]
    return line[left <= BRIDGED] if (left <= BRIDGED).sum() > 1 else line[-2:]
