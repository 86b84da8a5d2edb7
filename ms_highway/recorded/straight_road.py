"""Straighten a recorded road: convert states on it to states on parallel lanes."""

from collections import deque
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np

from ms_highway.geometry.road_map import Lane, road_map
from ms_highway.recorded.network import Axes, network_of
from ms_highway.recorded.scenario import Points, RecordedTrack, TrafficRecording
from ms_highway.runtime.arrays import State


class LanePlace(NamedTuple):
    """Where a lane is on the straight road.

    Attributes:
        row: index of the lane's row, counted to the right from any lane.
        start: x where the lane begins [m].
    """

    row: int
    start: float


class StraightRoad:
    """The road of a recording, straightened to parallel lanes.

    They are as far apart as the recorded lanes are wide. On the straight road, x is the
    distance along the road, y the distance to the right of the leftmost lane's centre,
    and headings are relative to the lane. Where lanes side by side differ in length, x
    is scaled to their mean.

    Attributes:
        axes: of highway-env in the map of the recording.
        network: of the lanes.
        centres: y of each lane, by its index in the network; lanes that follow each
            other have the same y.
        lane_width: median width of the lanes [m].

    Raises:
        ValueError: for lanelets that cannot be driven, with the reason.
    """

    continuation: ClassVar[float] = 50.0
    """Length by which the surface goes on beyond the ends of the road [m]."""
    edge_tolerance: ClassVar[float] = 0.1
    """Width by which lanes are widened to each side [m]: their edges may leave gaps."""

    def __init__(self, recording: TrafficRecording) -> None:
        if not recording.lanelets:
            raise ValueError(
                "there are no lanelets on which cars drive; give a recording of a road"
            )
        self.axes = Axes.of(recording.lanelets)
        self.network = network_of(recording.lanelets, self.axes)
        self._lanes = [*road_map(self.network).lanes.values()]

        # The row of each lane, from 0 for the leftmost one.
        places = _place_lanes(self._lanes)
        self._starts = np.array([places[lane].start for lane in self._lanes])
        rows = np.array([places[lane].row for lane in self._lanes])
        rows -= rows.min()

        # The median width of each row; rows between unconnected roads have no lanes.
        widths = np.array(
            [lane.shape.width_at(lane.length / 2) for lane in self._lanes]
        )
        self.lane_width = float(np.median(widths))
        row_widths = np.full(rows.max() + 1, self.lane_width)
        for row in rows:
            row_widths[row] = np.median(widths[rows == row])

        # The centre of each row, from the leftmost one.
        right_edges = np.cumsum(row_widths)
        y = right_edges - (row_widths + row_widths[0]) / 2
        self.centres = {}
        for lane, row in zip(self._lanes, rows, strict=True):
            self.centres[lane.index] = float(y[row])

    def __deepcopy__(self, memo: object) -> "StraightRoad":
        return self  # it never changes: copies of environments share it

    def states(self, states: State) -> State:
        """Convert states in highway-env's axes, each by the nearest lane."""
        x, y, heading, speeds = states.T
        projected = [lane.shape.curve.project(x, y, heading) for lane in self._lanes]
        poses = np.array(projected)  # [lanes, (along, offset, heading), states]

        # The nearest lane, in position and heading as highway-env measures it.
        along, offset, heading = poses.swapaxes(0, 1)  # [lanes, states] each
        lengths = np.array([[lane.length] for lane in self._lanes])
        beyond_end = np.maximum(along - lengths, 0.0)
        before_start = np.maximum(-along, 0.0)
        beyond_ends = beyond_end + before_start
        distances = np.abs(offset) + beyond_ends + np.abs(heading)
        nearest = distances.argmin(axis=0)
        lanes = [self._lanes[index] for index in nearest]

        # The place on the straight road: along a lane, x grows by its road's length.
        pose_on_nearest = poses[nearest, :, np.arange(len(states))]  # [states, 3]
        along, offset, heading = pose_on_nearest.T
        scales = [_mean_length(lane) / lane.length for lane in lanes]
        centres = [self.centres[lane.index] for lane in lanes]
        straight_x = self._starts[nearest] + along * scales
        straight_y = offset + centres
        return np.stack([straight_x, straight_y, heading, speeds], axis=-1)

    @property
    def lines(self) -> list[Points]:
        """The middles of the lanes for every y, from the left, one after the other."""
        order = np.argsort(self._starts, kind="stable")
        lanes = [self._lanes[number] for number in order]
        lines = []
        for y in sorted(set(self.centres.values())):
            in_row = [lane for lane in lanes if self.centres[lane.index] == y]
            middles = [lane.shape.centres for lane in in_row]
            lines.append(np.concatenate(middles))
        return lines

    def states_of_track(self, track: RecordedTrack) -> State:
        """Return the recorded states of a track on the straight road."""
        return self.states(self.axes.states(track.samples))

    def covers(self, points: Points) -> bool:
        """Return whether all points are on the road.

        It goes straight on beyond its ends, by `continuation`.
        """
        on_road = np.zeros(len(points), bool)
        for lane in self._lanes:
            along, offset = lane.shape.curve.locate(points)
            before = 0.0 if lane.preceding else self.continuation
            after = 0.0 if lane.following() else self.continuation
            is_along = (-before <= along) & (along <= lane.length + after)
            widths = lane.shape.curve.interpolate(lane.shape.widths, along)
            half_widths = widths / 2 + self.edge_tolerance
            is_within = np.abs(offset) <= half_widths
            on_road |= is_along & is_within
        return bool(on_road.all())


@lru_cache(TrafficRecording.cache_size)
def straight_road(recording: TrafficRecording) -> StraightRoad:
    """Return the road of a recording; the roads of the last recordings are cached."""
    return StraightRoad(recording)


def _place_lanes(lanes: list[Lane]) -> dict[Lane, LanePlace]:
    """Return where each lane is on the straight road.

    It is in the row of the lanes before and after it, and in the next row to those
    beside it. Roads that are not connected begin at x = 0 each, with a free row between
    them.
    """
    places: dict[Lane, LanePlace] = {}
    for first in lanes:
        if first not in places:
            last_row = max((place.row for place in places.values()), default=-2)
            _place_connected(first, LanePlace(last_row + 2, 0.0), lanes, places)
    return places


def _place_connected(
    first: Lane,
    place: LanePlace,
    lanes: list[Lane],
    places: dict[Lane, LanePlace],
) -> None:
    """Add the places of a lane and of all that are connected with it, nearest first."""
    queue = deque([(first, place)])
    while queue:
        lane, place = queue.popleft()
        if lane in places:
            continue
        places[lane] = place
        for beside in lane.siblings:
            row = place.row + beside.number - lane.number
            queue.append((beside, LanePlace(row, place.start)))
        for after in lane.following():
            end = place.start + _mean_length(lane)
            queue.append((after, LanePlace(place.row, end)))
        for before in lanes:
            if lane in before.following():
                start = place.start - _mean_length(before)
                queue.append((before, LanePlace(place.row, start)))


def _mean_length(lane: Lane) -> float:
    """Return the mean length of the lanes of a lane's road [m]."""
    return float(np.mean([beside.length for beside in lane.siblings]))
