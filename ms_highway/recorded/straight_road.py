"""Convert states of vehicles on a recorded road to states on a straight road of
parallel lanes, lane by lane.
"""

from functools import lru_cache

import numpy as np

from ms_highway.geometry.road_map import Lane, road_map
from ms_highway.recorded.network import Axes, network_of
from ms_highway.recorded.scenario import KEPT, Points, RecordedTrack, TrafficRecording
from ms_highway.runtime.arrays import State

ONWARD = 50.0  # m, by which the surface goes on beyond the ends of the road
# m, by which lanes are widened to each side, because their edges may leave gaps
SEAM = 0.1


class StraightRoad:
    """The road of a recording, straightened: its lanes are parallel lines, as far apart
    as the lanes are wide.

    On the straight road, x is the distance along the road, y the distance to the right
    of the leftmost lane's centre, and headings are relative to the lane. Where lanes
    side by side differ in length, x is scaled to their mean.

    Attributes:
        axes: of highway-env in the map of the recording.
        network: of the lanes.
        centres: y of each lane, by its index in the network; lanes that follow each
            other have the same y.
        lane_width: median width of the lanes [m].

    Raises:
        ValueError: for lanelets that cannot be driven, with the reason.
    """

    def __init__(self, recording: TrafficRecording) -> None:
        if not recording.lanelets:
            raise ValueError(
                "there are no lanelets on which cars drive; give a recording of a road"
            )
        self.axes = Axes.of(recording.lanelets)
        self.network = network_of(recording.lanelets, self.axes)
        self._lanes = [*road_map(self.network).lanes.values()]
        found: dict[
            Lane, tuple[int, float]
        ] = {}  # number of each lane from the left, and x where it begins
        for first in self._lanes:
            queue = [
                (
                    first,
                    2 + max((number for number, _ in found.values()), default=-2),
                    0.0,
                )
            ]  # roads stay apart
            for lane, number, start in queue:
                if lane not in found:
                    found[lane] = number, start
                    queue += [
                        (beside, number + beside.number - lane.number, start)
                        for beside in lane.siblings
                    ]
                    queue += [
                        (after, number, start + _length(lane))
                        for after in lane.following()
                    ]
                    before = [
                        other for other in self._lanes if lane in other.following()
                    ]
                    queue += [
                        (other, number, start - _length(other)) for other in before
                    ]
        numbers, self._starts = map(
            np.array, zip(*(found[lane] for lane in self._lanes), strict=True)
        )
        numbers -= numbers.min()
        widths = np.array(
            [lane.shape.width_at(lane.length / 2) for lane in self._lanes]
        )
        self.lane_width = float(np.median(widths))
        medians = np.full(numbers.max() + 1, self.lane_width)
        for number in numbers:
            medians[number] = np.median(widths[numbers == number])
        y = np.cumsum(medians) - (medians + medians[0]) / 2
        self.centres = {
            lane.index: float(y[number])
            for lane, number in zip(self._lanes, numbers, strict=True)
        }

    def __deepcopy__(self, memo: object) -> "StraightRoad":
        return self  # it never changes: copies of environments share it

    def states(self, states: State) -> State:
        """Convert states in highway-env's axes, each by the lane that is nearest in
        position and heading.
        """
        x, y, heading, speeds = states.T
        every = np.array(
            [lane.shape.curve.project(x, y, heading) for lane in self._lanes]
        )  # [lanes, 3, n]
        along, aside, heading = every.swapaxes(0, 1)
        lengths = np.array([[lane.length] for lane in self._lanes])
        beyond = np.maximum(along - lengths, 0.0) + np.maximum(-along, 0.0)
        nearest = (np.abs(aside) + beyond + np.abs(heading)).argmin(
            axis=0
        )  # as highway-env measures distances
        along, aside, heading = every[nearest, :, np.arange(len(states))].T
        lanes = [self._lanes[number] for number in nearest]
        x = self._starts[nearest] + along * [
            _length(lane) / lane.length for lane in lanes
        ]
        y = aside + [self.centres[lane.index] for lane in lanes]
        return np.stack([x, y, heading, speeds], axis=-1)

    @property
    def lines(self) -> list[Points]:
        """For every y of lanes, from the left: the middles of the lanes there, one
        after the other.
        """
        lanes = [
            self._lanes[place] for place in np.argsort(self._starts, kind="stable")
        ]
        rows = sorted(set(self.centres.values()))
        return [
            np.concatenate(
                [lane.shape.centres for lane in lanes if self.centres[lane.index] == y]
            )
            for y in rows
        ]

    def way(self, track: RecordedTrack) -> State:
        """Return the recorded states of a track on the straight road."""
        return self.states(self.axes.states(track.samples))

    def covers(self, points: Points) -> bool:
        """Return whether all points are on lanes, or on their straight continuation
        beyond the ends of the road.
        """
        inside = np.zeros(len(points), bool)
        for lane in self._lanes:
            along, aside = lane.shape.curve.locate(points)
            first = 0.0 if lane.preceding else -ONWARD
            last = lane.length + (0.0 if lane.following() else ONWARD)
            widths = lane.shape.curve.interpolate(lane.shape.widths, along)
            inside |= (
                (first <= along)
                & (along <= last)
                & (np.abs(aside) <= widths / 2 + SEAM)
            )
        return bool(inside.all())


straight_road = lru_cache(KEPT)(StraightRoad)
"""Return the road of a recording; the last `KEPT` roads are kept."""


def _length(lane: Lane) -> float:
    """Return the mean length of the lanes of a lane's road [m]."""
    return float(np.mean([beside.length for beside in lane.siblings]))
