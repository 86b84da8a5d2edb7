"""Find a road's lanes among lanelets, and measure along and across them.

In a map, y points to the left of x: so is the d of curve coordinates.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_smoothing_spline

from ms_highway.geometry.curve import Curve, arc_lengths, resample
from ms_highway.recorded.scenario import Lanelet, Points

Values = Float[np.ndarray, "n"]

LANE_SPREAD = 0.5  # m, median deviation from the median offset, above which lanes are not parallel
DISTINCT_LANES = 1.0  # m, offset below which chains of lanelets are one lane

SPACING = 0.5  # m, between samples of curves
SMOOTHED = 10.0, 5.0, 2.5, 1.25, 0.625  # m; waves shorter than 2 pi times that, at first about 60 m, are smoothed
KINKS = 0.2  # m, by which lines of maps, such as those of US-101, are jagged
FEWEST_POINTS = 5  # that a smoothing spline can be fitted to


class MeasuredRoad(NamedTuple):
    """The lanes of a road that are parallel.

    Attributes:
        curve: of the leftmost of them, in the map.
        lanes: how far each lane's centre is to the right of it, ascending [m].
        lane_width: of a lane [m].
    """

    curve: Curve
    lanes: Values
    lane_width: float


def fits(line: Points) -> Iterator[Curve]:
    """Yield curves along a line, first smoothed much: lines of maps have kinks that would look like steering."""
    line = line[np.r_[True, np.any(np.diff(line, axis=0) != 0, axis=-1)]]
    distance = arc_lengths(line.T)
    for smoothed in SMOOTHED:
        spacing = smoothed / 2
        even = np.linspace(0, distance[-1], max(round(distance[-1] / spacing) + 1, FEWEST_POINTS))
        points = np.stack([np.interp(even, distance, coordinate) for coordinate in line.T], axis=-1)
        smooth = make_smoothing_spline(even, points, lam=smoothed**4 / spacing)
        step = min(SPACING, distance[-1] / FEWEST_POINTS)
        x, y = resample(smooth(np.arange(0.0, distance[-1] + step, step / 2)).T, step)
        yield Curve.through(x, y, spacing=step)


def dense(line: Points) -> Points:
    """Return the points of a line, and more between those that are farther than a metre apart."""
    places = arc_lengths(line.T)
    even = np.union1d(places, np.arange(0.0, places[-1], 1.0))
    return np.stack([np.interp(even, places, part) for part in line.T], axis=-1)


def fit_curve(line: Points) -> Curve:
    """Fit a curve to a line, smoothed as much as its bends allow."""
    for curve in fits(line):
        _, aside = curve.locate(dense(line))
        if np.abs(aside).max() <= KINKS:
            break
    return curve


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
            found = _offsets(fit_curve(line), lines)
            alone &= np.isnan(found)
            offsets = max(offsets, found, key=lambda offset: np.isfinite(offset).sum())
    if not np.isfinite(offsets).any():
        raise ValueError("no lane is straight enough to measure driving along it")
    leftmost = int(np.nanargmin(offsets))
    curve = fit_curve(lines[leftmost])
    found = np.sort(_offsets(curve, lines))
    found = found[np.isfinite(found)]
    lanes = found[np.r_[True, np.diff(found) > DISTINCT_LANES]]
    lanelet = chains[leftmost][0]
    widths = np.linalg.norm(lanelet.left - lanelet.right, axis=-1)
    return MeasuredRoad(curve, lanes, float(np.median(np.diff(lanes) if len(lanes) > 1 else widths)))


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


def _offsets(curve: Curve, lines: list[Points]) -> Values:
    """Return how far to the right of a road's reference line other lines are; NaN for those that are no lanes of it.

    Lanes run in the road's direction and parallel to it, except at the ends. In recording 10 of US-101, a ramp comes
    from 40 m away: nobody drives at its median offset, 23 m.
    """
    offsets = np.full(len(lines), np.nan)
    s, d = curve.locate(np.concatenate(lines))
    ends = np.cumsum([len(line) for line in lines])[:-1]
    for line, (x, y) in enumerate(zip(np.split(s, ends), np.split(-d, ends), strict=True)):
        middle = np.median(y)
        if x[-1] > x[0] and np.median(np.abs(y - middle)) < LANE_SPREAD:
            offsets[line] = middle
    return offsets
