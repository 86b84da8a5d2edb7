"""Straighten a recorded road: lanes become parallel lines of one width, on which learned drivers drive."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ms_highway.envs.recorded.lane_coordinates import LaneCoordinates, Values, measure_road, side_by_side
from ms_highway.envs.recorded.scenario import Lanelet, Points, RecordedTrack
from ms_highway.game.road import wrapped

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
        coordinates: along the road and across it, in the map.
        centres: lateral position of each lane in these coordinates, every `STEP` metres [lanes, places].
        there: where each lane exists.
        lane_width: [m].
    """

    coordinates: LaneCoordinates
    centres: Float[np.ndarray, "lanes places"]
    there: Bool[np.ndarray, "lanes places"]
    lane_width: float

    @classmethod
    def of(cls, lanelets: tuple[Lanelet, ...]) -> "StraightRoad":
        """Measure the road that lanelets make.

        Raises:
            ValueError: if it is none, or goes in two directions.
        """
        road, numbers = measure_road(lanelets), _lane_numbers(side_by_side(lanelets))
        places = STEP * np.arange(int(road.coordinates.length / STEP) + 2)
        centres = np.full((1 + max(numbers.values()), len(places)), np.nan)
        for lanelet in lanelets:
            located, lane = road.coordinates.locate(lanelet.centre), numbers[lanelet.number]
            if located.x[-1] < located.x[0]:
                raise ValueError(
                    f"lanelet {lanelet.number} goes against the others; only roads of one direction can be driven here"
                )
            inside = (places >= located.x.min() - STEP) & (places <= located.x.max() + STEP)
            order = np.argsort(located.x, kind="stable")
            centres[lane, inside] = np.interp(places[inside], located.x[order], located.y[order])
        return cls(road.coordinates, _spread(centres), np.isfinite(centres), road.lane_width)

    @property
    def lanes(self) -> Values:
        """Lateral position of the middle of each lane [m]."""
        return self.lane_width * np.arange(len(self.centres))

    def lane_ends(self, lane: int, x: float) -> float:
        """Return how far ahead of a place a lane ends [m]; infinite if it goes on to the end of the road."""
        ahead = self.there[lane, min(max(round(x / STEP), 0), self.there.shape[1] - 1) :]
        return np.inf if ahead.all() else STEP * float(np.argmin(ahead))

    def straighten(self, points: Points, orientations: Values, speeds: Values) -> States:
        """Return states x, y, heading and speed on the straight road of poses in the map."""
        x, across, along = self.coordinates.locate(points)
        y = _mapped(across, self._middles(x), self.lanes[:, None])
        return np.stack([x, y, wrapped(along - orientations - self._slope(x, y)), speeds], axis=-1)

    def path(self, track: RecordedTrack) -> States:
        """Return the states of a track on the straight road."""
        return self.straighten(track.samples[:, 1:3], *track.samples[:, 3:].T)

    def bend(self, states: States) -> tuple[Points, Values]:
        """Return points and orientations in the map of states on the straight road."""
        x, y, heading, _ = states.T
        points, along = self.coordinates.place(x, self._bent(x, y))
        return points, wrapped(along - heading - self._slope(x, y))

    def along(self, point: Points) -> float:
        """Return the place along the road of a point of the map [m]."""
        return float(self.coordinates.locate(np.asarray(point)[None]).x[0])

    def _middles(self, x: Values) -> np.ndarray:
        """Return the lateral positions of all lanes at some places [lanes, places]."""
        place = np.clip(x / STEP, 0.0, self.centres.shape[1] - 1.001)
        low = place.astype(int)
        share = place - low
        return self.centres[:, low] * (1 - share) + self.centres[:, low + 1] * share

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

    order = np.argsort(-np.isfinite(centres).sum(axis=1), kind="stable")
    done = [int(order[0])]
    centres = centres.copy()
    centres[done[0]] = filled(centres[done[0]])
    for lane in sorted(order[1:].tolist(), key=lambda other: abs(other - done[0])):
        beside = min(done, key=lambda other: abs(other - lane))
        centres[lane] = centres[beside] + filled(centres[lane] - centres[beside])
        done.append(lane)
    for lane in range(1, len(centres)):
        centres[lane] = np.maximum(centres[lane], centres[lane - 1] + CLOSEST)
    return centres


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
