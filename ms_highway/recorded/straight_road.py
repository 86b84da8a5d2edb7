"""Describe vehicles by the lanes that they are in, as on a straight road of parallel lanes of one width."""

from collections.abc import Collection
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Float, Int

from ms_highway.geometry.curve import wrapped
from ms_highway.geometry.road_map import Lane, road_map
from ms_highway.recorded.network import Axes, Values, network_of
from ms_highway.recorded.scenario import KEPT, Points, RecordedTrack, TrafficRecording

ONWARD = 50.0  # m, by which the surface goes on beyond the ends of the road
SEAM = 0.1  # m, by which lanes are widened to each side: their edges hardly touch

States = Float[np.ndarray, "n 4"]


class LanePoses(NamedTuple):
    """Poses of n vehicles, each in the coordinates of the lane that is nearest in position and heading.

    Attributes:
        lane: number of the lane in ``StraightRoad.lanes``.
        along: distance from the beginning of the lane [m].
        aside: distance to the right of its centre [m].
        heading: relative to the lane, to the right [rad].
    """

    lane: Int[np.ndarray, "n"]
    along: Values
    aside: Values
    heading: Values


class StraightRoad:
    """The road of a recording, and its lanes as parallel lines, at 0, 1, ... widths to the right of the leftmost one.

    On the straight road, x is the distance along the road, y that to the right of the leftmost lane's centre, and
    headings are relative to the lane. Where lanes side by side differ in length, x is scaled to their mean.

    Attributes:
        axes: of highway-env in the map of the recording.
        network: of the lanes.
        lanes: all lanes of the network.
        numbers: of each lane, from the left; a lane that follows another one has its number [lanes].
        starts: place along the road at which each lane begins [lanes].
        scales: of distances along each lane [lanes].
        lane_width: median width of the lanes [m].

    Raises:
        ValueError: for lanelets that cannot be driven, with the reason.
    """

    def __init__(self, recording: TrafficRecording) -> None:
        if not recording.lanelets:
            raise ValueError("there are no lanelets on which cars drive; give a recording of a road")
        self.axes = Axes.of(recording.lanelets)
        self.network = network_of(recording.lanelets, self.axes)
        self.lanes = [*road_map(self.network).lanes.values()]
        found: dict[Lane, tuple[int, float]] = {}
        for first in self.lanes:  # separate roads have no lanes in common, nor next to each other
            queue = [(first, 2 + max((number for number, _ in found.values()), default=-2), 0.0)]
            for lane, number, start in queue:
                if lane not in found:
                    found[lane] = number, start
                    queue += [(beside, number + beside.number - lane.number, start) for beside in lane.siblings]
                    queue += [(after, number, start + _length(lane)) for after in lane.following()]
                    before = [other for other in self.lanes if lane in other.following()]
                    queue += [(other, number, start - _length(other)) for other in before]
        numbers, starts = zip(*map(found.__getitem__, self.lanes), strict=True)
        self.numbers, self.starts = np.array(numbers) - min(numbers), np.array(starts)
        self.scales = np.array([_length(lane) / lane.length for lane in self.lanes])
        self.lane_width = float(np.median([lane.shape.width_at(lane.length / 2) for lane in self.lanes]))

    def poses(self, positions: Points, headings: Values) -> LanePoses:
        """Return poses in highway-env's axes in the coordinates of lanes."""
        every = np.array([lane.shape.curve.project(*positions.T, headings) for lane in self.lanes])  # [lanes, 3, n]
        along, aside, heading = every.swapaxes(0, 1)
        beyond = np.maximum(along - [[lane.length] for lane in self.lanes], 0.0) + np.maximum(-along, 0.0)
        nearest = (np.abs(aside) + beyond + np.abs(heading)).argmin(axis=0)  # as highway-env measures distances
        return LanePoses(nearest, *every[nearest, :, np.arange(len(positions))].T)

    def poses_of(self, vehicles: Collection[Vehicle]) -> LanePoses:
        """Return the poses of vehicles in the coordinates of lanes."""
        positions, headings = zip(*((vehicle.position, vehicle.heading) for vehicle in vehicles), strict=True)
        return self.poses(np.array(positions), np.array(headings))

    def states(self, poses: LanePoses, speeds: Values) -> States:
        """Return states x, y, heading and speed on the straight road."""
        lane, along, aside, heading = poses
        widths = [self.lanes[number].shape.width_at(place) for number, place in zip(lane, along, strict=True)]
        y = self.lane_width * (self.numbers[lane] + aside / widths)
        return np.stack([self.starts[lane] + along * self.scales[lane], y, heading, speeds], axis=-1)

    def along(self, vehicle: Vehicle) -> float:
        """Return the place of a vehicle along the road [m]."""
        return float(self.states(self.poses_of([vehicle]), np.zeros(1))[0, 0])

    def covers(self, points: Points) -> bool:
        """Return whether all points are on lanes, or straight on beyond the ends of the road."""
        inside = np.zeros(len(points), bool)
        for lane in self.lanes:
            along, aside = lane.shape.curve.locate(points)
            first, last = 0.0 if lane.preceding else -ONWARD, lane.length + (0.0 if lane.following() else ONWARD)
            widths = lane.shape.curve.interpolate(lane.shape.widths, along)
            inside |= (first <= along) & (along <= last) & (np.abs(aside) <= widths / 2 + SEAM)
        return bool(inside.all())

    def moved(self, poses: LanePoses, car: int, step: Points, heading: float) -> tuple[Points, float]:
        """Return position and heading of a car in highway-env's axes after a step.

        Args:
            poses: of all cars before.
            car: number of the car.
            step: along its lane and to the right [2, m].
            heading: after the step, relative to the lane [rad].
        """
        shape, along = self.lanes[poses.lane[car]].shape, poses.along[car] + step[0]
        return shape.position(along, poses.aside[car] + step[1]), float(wrapped(shape.heading_at(along) + heading))

    def way(self, track: RecordedTrack) -> tuple[States, Int[np.ndarray, "times"]]:
        """Return the states of a track on the straight road, and the numbers of the lanes that it was in."""
        _, x, y, orientations, speeds = track.samples.T
        poses = self.poses(self.axes.positions(np.stack([x, y], axis=-1)), self.axes.headings(orientations))
        return self.states(poses, speeds), self.numbers[poses.lane]


straight_road = lru_cache(KEPT)(StraightRoad)
"""Return the road of a recording, the same one as long as it is kept."""


def _length(lane: Lane) -> float:
    """Return the mean length of a lane and those beside it [m]."""
    return float(np.mean([beside.length for beside in lane.siblings]))
