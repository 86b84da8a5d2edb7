"""Straighten a recorded road: lanes become parallel lines of one width, on which learned drivers drive."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Bool, Float
from scipy.interpolate import BSpline, make_interp_spline

from ms_highway.geometry.curve import Curve, wrapped
from ms_highway.recorded.lane_coordinates import Values, measure_road, side_by_side
from ms_highway.recorded.network import Axes
from ms_highway.recorded.scenario import Lanelet, Points, RecordedTrack

STEP = 2.0  # m, between the places at which lanes are measured
CLOSEST = 1.5  # m between the middles of two lanes, where they join or part
BEYOND = 1000.0  # m, beyond the outermost lanes, up to which places are mapped
NEARBY = 1.0  # m, along the road, to each side of a place, by which the slope of a lane is measured

States = Float[np.ndarray, "cars 4"]


@dataclass(frozen=True)
class StraightRoad:
    """A road with n lanes, numbered from the left, whose middles are at 0, 1, ..., n - 1 widths.

    A position is x, along the road, and y, to the right of the leftmost lane's middle; between the middles of two
    lanes, y is stretched.

    Attributes:
        axes: of highway-env.
        curve: along the road, in the map.
        centres: how far all lanes are to the right of it, from the way along the road [places, lanes].
        there: whether each lane exists, every `STEP` metres [lanes, places].
        lane_width: [m].
    """

    axes: Axes
    curve: Curve
    centres: BSpline
    there: Bool[np.ndarray, "lanes places"]
    lane_width: float

    @classmethod
    def of(cls, lanelets: tuple[Lanelet, ...]) -> "StraightRoad":
        """Measure the road that lanelets make.

        Raises:
            ValueError: if it is none, or goes in two directions.
        """
        road, numbers = measure_road(lanelets), _lane_numbers(side_by_side(lanelets))
        places = STEP * np.arange(int(road.curve.end / STEP) + 2)
        centres = np.full((1 + max(numbers.values()), len(places)), np.nan)
        for lanelet in lanelets:
            x, left = road.curve.locate(lanelet.centre)
            lane = numbers[lanelet.number]
            if x[-1] < x[0]:
                raise ValueError(
                    f"lanelet {lanelet.number} goes against the others; only roads of one direction can be driven here"
                )
            inside = (places >= x.min() - STEP) & (places <= x.max() + STEP)
            order = np.argsort(x, kind="stable")
            centres[lane, inside] = np.interp(places[inside], x[order], -left[order])
        middles = make_interp_spline(places, _spread(centres).T, k=1)
        return cls(Axes.of(lanelets), road.curve, middles, np.isfinite(centres), road.lane_width)

    @property
    def lanes(self) -> Values:
        """Lateral position of the middle of each lane [m]."""
        return self.lane_width * np.arange(len(self.there))

    def lane_ends(self, lane: int, x: float, within: float) -> bool:
        """Return whether a lane ends within a distance ahead of a place [m]."""
        place = min(max(round(x / STEP), 0), self.there.shape[1] - 1)
        return not self.there[lane, place : place + round(within / STEP)].all()

    def straighten(self, points: Points, orientations: Values, speeds: Values) -> States:
        """Return states x, y, heading and speed on the straight road of poses in the map."""
        x, left, turned = self.curve.project(points[:, 0], points[:, 1], orientations)
        y = _mapped(-left, self._middles(x), self.lanes[:, None])
        return np.stack([x, y, wrapped(-turned - self._slope(x, y)), speeds], axis=-1)

    def path(self, track: RecordedTrack) -> States:
        """Return the states of a track on the straight road."""
        return self.straighten(track.samples[:, 1:3], *track.samples[:, 3:].T)

    def states(self, vehicles: Collection[Vehicle]) -> States:
        """Return the states of highway-env's vehicles on the straight road."""
        positions, headings, speeds = zip(
            *((item.position, item.heading, item.speed) for item in vehicles), strict=True
        )
        return self.straighten(self.axes.points(positions), self.axes.orientations(headings), np.array(speeds))

    def bend(self, states: States) -> tuple[Points, Values]:
        """Return positions and headings in highway-env of states on the straight road."""
        x, y, heading, _ = states.T
        *points, along = self.curve.place(x, -self._bent(x, y))
        return self.axes.positions(np.stack(points, axis=-1)), self.axes.headings(along - heading - self._slope(x, y))

    def along(self, vehicle: Vehicle) -> float:
        """Return the place along the road of a vehicle of highway-env [m]."""
        return float(self.curve.locate(self.axes.points(vehicle.position))[0])

    def _middles(self, x: Values) -> np.ndarray:
        """Return the lateral positions of all lanes at some places [lanes, places]."""
        return self.centres(np.clip(x, 0.0, STEP * (self.there.shape[1] - 1))).T

    def _bent(self, x: Values, y: Values) -> Values:
        return _mapped(y, self.lanes[:, None], self._middles(x))

    def _slope(self, x: Values, y: Values) -> Values:
        """Return the angle to the road's direction, to the right, of a line along the lanes."""
        return np.arctan2(self._bent(x + NEARBY, y) - self._bent(x - NEARBY, y), 2 * NEARBY)


def _mapped(values: Values, known: np.ndarray, images: np.ndarray) -> Values:
    """Map each value linearly between known values, ascending in the first axis; beyond the outermost, shift it."""
    both = np.broadcast_arrays(known, images)
    known, images = (np.vstack([part[:1] - BEYOND, part, part[-1:] + BEYOND]) for part in both)
    columns = np.arange(len(values))
    low = np.clip((values >= known).sum(axis=0) - 1, 0, len(known) - 2)
    step, image_step = (part[low + 1, columns] - part[low, columns] for part in (known, images))
    return images[low, columns] + (values - known[low, columns]) / step * image_step


def _spread(centres: np.ndarray) -> np.ndarray:
    """Fill in lanes where they do not exist, as far from their neighbours as where they do, and keep lanes apart."""
    places = np.arange(centres.shape[1])

    def filled(values: np.ndarray) -> np.ndarray:
        known = np.isfinite(values)
        return np.interp(places, places[known], values[known])

    longest, whole = int(np.isfinite(centres).sum(axis=1).argmax()), np.empty_like(centres)
    whole[longest] = filled(centres[longest])
    for lane in range(longest + 1, len(centres)):
        whole[lane] = whole[lane - 1] + filled(centres[lane] - whole[lane - 1])
    for lane in reversed(range(longest)):
        whole[lane] = whole[lane + 1] + filled(centres[lane] - whole[lane + 1])
    least = CLOSEST * np.arange(len(centres))[:, None]
    return np.maximum.accumulate(whole - least) + least


def _lane_numbers(roads: list[list[Lanelet]]) -> dict[int, int]:
    """Return the number of each lanelet's lane, from 0 at the left; a lanelet that follows another keeps its number."""
    places = {lanelet.number: (road, place) for road in roads for place, lanelet in enumerate(road)}
    numbers: dict[int, int] = {}
    for first in roads:
        queue = [(first[0].number, 0)]
        for found, number in queue:
            if found in numbers or found not in places:
                continue
            road, place = places[found]
            for own, lanelet in enumerate(road, number - place):
                numbers[lanelet.number] = own
                queue += [(other, own) for other in (*lanelet.after, *lanelet.before)]
    least = min(numbers.values())
    return {lanelet: number - least for lanelet, number in numbers.items()}
