"""Find a road's lanes among lanelets, and measure along and across them."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, make_smoothing_spline
from scipy.spatial import cKDTree

from ms_highway.recorded.scenario import Lanelet, Points

Values = Float[np.ndarray, "n"]

LANE_SPREAD = 0.5  # m, median deviation from the median offset, above which lanes are not parallel
DISTINCT_LANES = 1.0  # m, offset below which chains of lanelets are one lane

SPACING = 5.0  # m, between the places where the nearest is looked for
SMOOTHED = 10.0, 5.0, 2.5, 1.25, 0.625  # m; waves shorter than 2 pi times that, at first about 60 m, are smoothed
KINKS = 0.2  # m, by which lines of maps, such as those of US-101, are jagged
FEWEST_POINTS = 5  # that a smoothing spline can be fitted to
ITERATIONS = 6  # each reduces the error to |offset / radius| of it, a few percent on a highway


class LanePosition(NamedTuple):
    """Positions of points on a road, arrays [points].

    Attributes:
        x: along the road [m].
        y: to the right of the reference line [m].
        heading: of the road at the point [rad], counterclockwise, in the coordinates of the map.
    """

    x: Values
    y: Values
    heading: Values


class LaneCoordinates(NamedTuple):
    """A smooth reference line, straight beyond its ends.

    Attributes:
        curve: from the distance along the line [m] to a point (x, y) of the map, whose y points to the left of its x.
        length: of the line [m].
    """

    curve: BSpline
    length: float

    def locate(self, points: Points) -> LanePosition:
        """Return the positions on the road of points of the map."""
        samples = np.linspace(0, self.length, max(int(self.length / SPACING), 2))
        x = samples[cKDTree(self.curve(samples)).query(points)[1]]
        for _ in range(ITERATIONS):
            on_line, tangent = self._frame(x)
            offset = points - on_line
            x = x + (offset * tangent).sum(axis=-1)
        right = offset[:, 0] * tangent[:, 1] - offset[:, 1] * tangent[:, 0]
        return LanePosition(x, right, np.arctan2(tangent[:, 1], tangent[:, 0]))

    def place(self, x: Values, y: Values) -> tuple[Points, Values]:
        """Return points of the map and the road's heading there, the inverse of `locate`."""
        on_line, tangent = self._frame(x)
        right = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
        return on_line + y[:, None] * right, np.arctan2(tangent[:, 1], tangent[:, 0])

    def _frame(self, x: Values) -> tuple[Points, Points]:
        """Return the points of the line at distances along it, and the unit tangents there."""
        inside = np.clip(x, 0, self.length)
        tangent = self.curve(inside, 1)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        return self.curve(inside) + (x - inside)[:, None] * tangent, tangent


class MeasuredRoad(NamedTuple):
    """The lanes of a road that are parallel.

    Attributes:
        coordinates: along the leftmost of them.
        lanes: lateral position of each lane's centre, ascending [m].
        lane_width: of a lane [m].
    """

    coordinates: LaneCoordinates
    lanes: Values
    lane_width: float


def fits(line: Points) -> Iterator[LaneCoordinates]:
    """Yield coordinates along a line, first smoothed much: lines of maps have kinks that would look like steering."""
    line = line[np.r_[True, np.any(np.diff(line, axis=0) != 0, axis=-1)]]
    distance = np.r_[0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=-1))]
    for smoothed in SMOOTHED:
        spacing = smoothed / 2
        even = np.linspace(0, distance[-1], max(round(distance[-1] / spacing) + 1, FEWEST_POINTS))
        points = np.stack([np.interp(even, distance, coordinate) for coordinate in line.T], axis=-1)
        yield LaneCoordinates(make_smoothing_spline(even, points, lam=smoothed**4 / spacing), float(distance[-1]))


def dense(line: Points) -> Points:
    """Return the points of a line, and more between those that are farther than a metre apart."""
    places = np.r_[0.0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))]
    even = np.union1d(places, np.arange(0.0, places[-1], 1.0))
    return np.stack([np.interp(even, places, part) for part in line.T], axis=-1)


def fit_lane_coordinates(line: Points) -> LaneCoordinates:
    """Fit coordinates to a line, smoothed as much as its curves allow."""
    for road in fits(line):
        if np.abs(road.locate(dense(line)).y).max() <= KINKS:
            break
    return road


def measure_road(lanelets: Sequence[Lanelet]) -> MeasuredRoad:
    """Return coordinates along the leftmost lane of those that are parallel, and where the others are.

    Raises:
        ValueError: if there is no lane, or none that is straight enough.
    """
    chains = list(_chains(lanelets))
    if not chains:
        raise ValueError("there are no lanelets from which lanes start; driving can only be judged on a road")
    lines = [np.concatenate([lanelet.centre for lanelet in chain]) for chain in chains]
    # Take the line that has most lines parallel to it, one of which stands for all: a ramp has none but itself.
    offsets, alone = np.full(len(lines), np.nan), np.full(len(lines), True)
    for place, line in enumerate(lines):
        if alone[place]:
            found = _offsets(fit_lane_coordinates(line), lines)
            alone &= np.isnan(found)
            offsets = max(offsets, found, key=lambda offset: np.isfinite(offset).sum())
    if not np.isfinite(offsets).any():
        raise ValueError("no lane is straight enough to measure driving along it")
    leftmost = int(np.nanargmin(offsets))
    road = fit_lane_coordinates(lines[leftmost])
    found = np.sort(_offsets(road, lines))
    found = found[np.isfinite(found)]
    lanes = found[np.r_[True, np.diff(found) > DISTINCT_LANES]]
    lanelet = chains[leftmost][0]
    widths = np.linalg.norm(lanelet.left - lanelet.right, axis=-1)
    return MeasuredRoad(road, lanes, float(np.median(np.diff(lanes) if len(lanes) > 1 else widths)))


def side_by_side(lanelets: Sequence[Lanelet]) -> list[list[Lanelet]]:
    """Return the roads, each with its lanelets from the left.

    Raises:
        ValueError: for lanes of two directions, or a lanelet that is beside itself.
    """
    known = {lanelet.number: lanelet for lanelet in lanelets}
    roads, placed = [], set[int]()
    for lanelet in lanelets:
        if known.keys() & set(lanelet.opposite):
            raise ValueError(
                f"lanelet {lanelet.number} is beside one of the other direction; only roads of one direction can be "
                "driven here"
            )
        if lanelet.number in placed:
            continue
        road = [lanelet]
        for side in (0, 1):
            while (beside := road[-side].beside[side]) in known:
                if beside in (other.number for other in road):
                    raise ValueError(f"lanelet {beside} is beside itself; mend the file or leave it out")
                road.insert(side * len(road), known[beside])
        roads.append(road)
        placed |= {other.number for other in road}
    return roads


def _chains(lanelets: Sequence[Lanelet]) -> Iterator[list[Lanelet]]:
    """Yield every lane: a lanelet without predecessor, and its successors, always the first of several."""
    known = {lanelet.number: lanelet for lanelet in lanelets}
    for start in lanelets:
        if known.keys() & set(start.before):
            continue
        chain = {start.number: start}
        while following := [i for i in known[next(reversed(chain))].after if i in known and i not in chain]:
            chain[following[0]] = known[following[0]]
        yield list(chain.values())


def _offsets(road: LaneCoordinates, lines: list[Points]) -> Values:
    """Return how far to the right of a road's reference line other lines are; NaN for those that are no lanes of it.

    Lanes run in the road's direction and parallel to it, except at the ends. In recording 10 of US-101, a ramp comes
    from 40 m away: nobody drives at its median offset, 23 m.
    """
    offsets = np.full(len(lines), np.nan)
    located, ends = road.locate(np.concatenate(lines)), np.cumsum([len(line) for line in lines])[:-1]
    for line, (x, y) in enumerate(zip(np.split(located.x, ends), np.split(located.y, ends), strict=True)):
        middle = np.median(y)
        if x[-1] > x[0] and np.median(np.abs(y - middle)) < LANE_SPREAD:
            offsets[line] = middle
    return offsets
