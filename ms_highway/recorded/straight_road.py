"""Describe vehicles by the lanes that they are in, as on a straight road of parallel lanes of one width."""

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Float

from ms_highway.geometry.road_map import Lane, road_map
from ms_highway.recorded.network import Axes, Values, network_of
from ms_highway.recorded.scenario import KEPT, Points, RecordedTrack, TrafficRecording

ONWARD = 50.0  # m, by which the surface goes on beyond the ends of the road
SEAM = 0.1  # m, by which lanes are widened to each side: their edges hardly touch

States = Float[np.ndarray, "n 4"]


class StraightRoad:
    """The road of a recording, and its lanes as parallel lines to the right of the leftmost one, as far as wide.

    On the straight road, x is the distance along the road, y that to the right of the leftmost lane's centre, and
    headings are relative to the lane. Where lanes side by side differ in length, x is scaled to their mean.

    Attributes:
        axes: of highway-env in the map of the recording.
        network: of the lanes.
        centres: y of each lane, by its index in the network; a lane that follows another has the same.
        lane_width: median width of the lanes [m].

    Raises:
        ValueError: for lanelets that cannot be driven, with the reason.
    """

    def __init__(self, recording: TrafficRecording) -> None:
        if not recording.lanelets:
            raise ValueError("there are no lanelets on which cars drive; give a recording of a road")
        self.axes = Axes.of(recording.lanelets)
        self.network = network_of(recording.lanelets, self.axes)
        self._lanes = [*road_map(self.network).lanes.values()]
        found: dict[Lane, tuple[int, float]] = {}
        for first in self._lanes:  # separate roads have no lanes in common, nor next to each other
            queue = [(first, 2 + max((number for number, _ in found.values()), default=-2), 0.0)]
            for lane, number, start in queue:
                if lane not in found:
                    found[lane] = number, start
                    queue += [(beside, number + beside.number - lane.number, start) for beside in lane.siblings]
                    queue += [(after, number, start + _length(lane)) for after in lane.following()]
                    before = [other for other in self._lanes if lane in other.following()]
                    queue += [(other, number, start - _length(other)) for other in before]
        numbers, starts = map(np.array, zip(*map(found.__getitem__, self._lanes), strict=True))
        widths = np.array([lane.shape.width_at(lane.length / 2) for lane in self._lanes])
        numbers, self._starts, self.lane_width = numbers - numbers.min(), starts, float(np.median(widths))
        of_number = [
            np.median(widths[numbers == each] if each in numbers else widths) for each in range(max(numbers) + 1)
        ]
        y = np.cumsum(of_number) - (np.array(of_number) + of_number[0]) / 2
        self.centres = {lane.index: float(y[number]) for lane, number in zip(self._lanes, numbers, strict=True)}

    def __deepcopy__(self, memo: object) -> "StraightRoad":
        return self  # what never changes is shared by copies of environments

    def states(self, positions: Points, headings: Values, speeds: Values) -> States:
        """Return states on the straight road, by the lane that is nearest in position and heading.

        Args:
            positions: in highway-env's axes [n, 2, m].
            headings: there [rad].
            speeds: [m/s].
        """
        every = np.array([lane.shape.curve.project(*positions.T, headings) for lane in self._lanes])  # [lanes, 3, n]
        along, aside, heading = every.swapaxes(0, 1)
        beyond = np.maximum(along - [[lane.length] for lane in self._lanes], 0.0) + np.maximum(-along, 0.0)
        nearest = (np.abs(aside) + beyond + np.abs(heading)).argmin(axis=0)  # as highway-env measures distances
        along, aside, heading = every[nearest, :, np.arange(len(positions))].T
        lanes = [self._lanes[number] for number in nearest]
        scales = np.array([_length(lane) / lane.length for lane in lanes])
        y = np.array([self.centres[lane.index] for lane in lanes]) + aside
        return np.stack([self._starts[nearest] + along * scales, y, heading, speeds], axis=-1)

    def states_of(self, vehicles: Iterable[Vehicle]) -> States:
        """Return the present states of vehicles on the straight road."""
        poses = np.array([(*vehicle.position, vehicle.heading, vehicle.speed) for vehicle in vehicles]).reshape(-1, 4)
        return self.states(poses[:, :2], poses[:, 2], poses[:, 3])

    @property
    def lines(self) -> list[Points]:
        """Middles of the lanes with the same y, one lane after the other, from the left."""
        order = sorted(range(len(self._lanes)), key=self._starts.__getitem__)
        own: dict[float, list[Points]] = {}
        for lane in (self._lanes[place] for place in order):
            own.setdefault(self.centres[lane.index], []).append(lane.shape.centres)
        return [np.concatenate(own[centre]) for centre in sorted(own)]

    def way(self, track: RecordedTrack) -> States:
        """Return the states of a track on the straight road."""
        _, x, y, orientations, speeds = track.samples.T
        return self.states(self.axes.positions(np.stack([x, y], axis=-1)), self.axes.headings(orientations), speeds)

    def covers(self, points: Points) -> bool:
        """Return whether all points are on lanes, or straight on beyond the ends of the road."""
        inside = np.zeros(len(points), bool)
        for lane in self._lanes:
            along, aside = lane.shape.curve.locate(points)
            first, last = 0.0 if lane.preceding else -ONWARD, lane.length + (0.0 if lane.following() else ONWARD)
            widths = lane.shape.curve.interpolate(lane.shape.widths, along)
            inside |= (first <= along) & (along <= last) & (np.abs(aside) <= widths / 2 + SEAM)
        return bool(inside.all())


straight_road = lru_cache(KEPT)(StraightRoad)
"""Return the road of a recording, the same one as long as it is kept."""


def _length(lane: Lane) -> float:
    """Return the mean length of a lane and those beside it [m]."""
    return float(np.mean([beside.length for beside in lane.siblings]))
