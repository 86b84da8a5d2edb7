"""Let the vehicles of a recording enter a road, drive there and leave it, as they were recorded or by IDM."""

from typing import Any, ClassVar

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.geometry.bodies import separation
from ms_highway.geometry.curve import rotated
from ms_highway.recorded.scenario import RecordedTrack, TrafficRecording
from ms_highway.recorded.straight_road import straight_road

BEYOND = 30.0  # m past the end of the road, where vehicles leave it
CLEAR = 2.0  # m that have to be free ahead of and behind a vehicle that enters


class GuidedVehicle(Vehicle):
    """A vehicle whose state after a step is given.

    Attributes:
        coming: position, heading and speed after the step; None if it has not acted, and keeps its velocity.
    """

    coming: tuple[np.ndarray, float, float] | None = None

    def act(self, action: Any = None) -> None:
        """Do nothing: the action is given."""

    def step(self, dt: float) -> None:
        """Move to the given state."""
        if self.coming is None:
            super().step(dt)
        else:
            (self.position, self.heading, self.speed), self.coming = self.coming, None
            self.on_state_update()


class RecordedRoad(Road):
    """A road for the vehicles of a recording. Only egos collide, where bodies overlap.

    Vehicles enter where and when they were recorded to. One that drives by itself waits until the place is free, and
    leaves at the end of the road.

    Args:
        recording: of the traffic.
        begin: step of the recording to begin at.
        left_out: number of the track whose place the ego takes; None for all tracks.
        np_random: for drivers that draw random numbers.

    Attributes:
        vehicle_type: of those who drive by themselves; None, if everybody is replayed. Other road users, such as
            pedestrians, always are.
        now: the present step of the recording.
        coming: tracks of the vehicles that have not entered yet.
    """

    vehicle_type: ClassVar[type[Vehicle] | None] = None
    vehicles: list[Any]

    def __init__(self, recording: TrafficRecording, begin: int, left_out: int | None, np_random: Any) -> None:
        road = straight_road(recording)
        super().__init__(road.network, np_random=np_random)
        self.axes = road.axes
        self.recording, self.begin, self.now = recording, begin, begin
        self.coming = [track for track in recording.tracks if track.number != left_out and track.last >= begin]
        self._let_enter()

    @property
    def waiting(self) -> list[RecordedTrack]:
        """Tracks of the vehicles that should have entered already, but found another vehicle in their place."""
        return [track for track in self.coming if track.first <= self.now]

    @property
    def others(self) -> list[Vehicle]:
        """The vehicles of the recording, each with its ``track``."""
        return [vehicle for vehicle in self.vehicles if hasattr(vehicle, "track")]

    def act(self) -> None:
        """Let all vehicles decide what to do in the next step."""
        super().act()
        for vehicle in self.others:
            if vehicle.replayed:
                vehicle.coming = self.recorded_state(vehicle.track, self.now + 1)

    def step(self, dt: float) -> None:
        """Move all vehicles for ``dt`` seconds, and let vehicles enter and leave."""
        for vehicle in self.vehicles:
            vehicle.step(dt)
        self.now += 1
        self.vehicles = [vehicle for vehicle in self.vehicles if not self._has_left(vehicle)]
        self._let_enter()
        for ego in [vehicle for vehicle in self.vehicles if not hasattr(vehicle, "track")]:
            for other in self.vehicles:
                if other is not ego and overlap(ego, other):
                    ego.crashed = other.crashed = True

    def recorded_state(self, track: RecordedTrack, step: int) -> tuple[np.ndarray, float, float]:
        """Return position, heading and speed at a step of a track, interpolated where it was not seen."""
        times, x, y, orientation, speed = track.samples.T
        *pose, now = (float(np.interp(step, times, part)) for part in (x, y, np.unwrap(orientation), speed))
        return *self.axes.pose(*pose), now

    def make(self, track: RecordedTrack) -> Vehicle:
        """Return the vehicle of a track where it enters."""
        kind = (track.drives and self.vehicle_type) or GuidedVehicle
        vehicle = sized(kind(self, *self.recorded_state(track, self.begin)), track.size)
        vehicle.track, vehicle.check_collisions, vehicle.follows_lanes = track, False, track.drives
        vehicle.replayed = not (track.drives and self.vehicle_type)
        return vehicle

    def _let_enter(self) -> None:
        for track in self.waiting:
            vehicle = self.make(track)
            if vehicle.replayed or self.now == self.begin or self._is_free_for(vehicle):
                self.vehicles.append(vehicle)
                self.coming.remove(track)

    def _is_free_for(self, vehicle: Vehicle) -> bool:
        """Return whether no other vehicle is where a vehicle enters, nor right ahead of or behind it."""
        for other in self.vehicles:
            x, y = other.position - vehicle.position
            ahead, aside = rotated(x, y, vehicle.heading)
            gap = abs(ahead) - (other.LENGTH + vehicle.LENGTH) / 2
            if gap < CLEAR and abs(aside) < (other.WIDTH + vehicle.WIDTH) / 2:
                return False
        return True

    def _has_left(self, vehicle: Vehicle) -> bool:
        """Return whether a vehicle is past the end of its track, or of the road if it drives by itself."""
        if not hasattr(vehicle, "track"):
            return False
        if vehicle.replayed:
            return vehicle.track.last < self.now
        place, _ = vehicle.lane.local_coordinates(vehicle.position)
        return place > vehicle.lane.length + BEYOND and not self.network.graph.get(vehicle.lane_index[1])


class IdmRoad(RecordedRoad):
    """A road on which vehicles drive by highway-env's IDM and MOBIL, each at most as fast as it was recorded."""

    vehicle_type = IDMVehicle

    def make(self, track: RecordedTrack) -> Vehicle:
        """Return the vehicle of a track where it enters."""
        vehicle = super().make(track)
        vehicle.target_speed = max(float(track.samples[:, 4].max()), 1.0)
        return vehicle


def sized(item: RoadObject, size: tuple[float, float]) -> RoadObject:
    """Give something on a road a length and a width [m], and return it."""
    item.LENGTH, item.WIDTH = map(float, size)
    item.diagonal = float(np.hypot(*size))
    return item


def overlap(one: RoadObject, other: RoadObject) -> bool:
    """Return whether the bodies of two things on a road overlap."""
    (pose, size), (other_pose, sizes) = (
        ((*item.position, item.heading), (item.LENGTH, item.WIDTH)) for item in (one, other)
    )
    return bool(separation(pose, size, other_pose, sizes) < 0)
