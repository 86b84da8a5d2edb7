"""Let recorded vehicles enter a road, drive there and leave it.

They are replayed, or driven by learned drivers or by IDM.
"""

from copy import copy
from typing import Any, ClassVar

import numpy as np
from highway_env.road.road import LaneIndex, Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.geometry.bodies import nearest_ahead, separation
from ms_highway.recorded.scenario import RecordedTrack, TrafficRecording
from ms_highway.recorded.straight_road import straight_road
from ms_highway.runtime.arrays import Car, State
from ms_highway.vehicle import FollowingVehicle, RoutedVehicle, states_of


class ReplayedVehicle(RoutedVehicle):
    """A vehicle that moves as it was recorded, in highway-env's colours."""

    COLOR = None


class LearnedVehicle(FollowingVehicle):
    """A learned driver in the place of a recorded vehicle.

    It changes lanes where the recorded vehicle did, as soon as there is room. Without a
    leader it drives as fast as the recorded vehicle at the same place, whose leader was
    out of sight of the recording.

    Attributes:
        recorded_states: of the recorded vehicle on the straight road [times, 4].
    """

    lane_change_time: ClassVar[float] = 2.0
    """Duration of a lane change [s]: it begins this long before the recorded vehicle
    was in the other lane.
    """
    gap_time: ClassVar[float] = 1.0
    """Time for which a gap in the lane beside must stay long enough at the present
    speeds [s].
    """
    speed_time: ClassVar[float] = 1.0
    """Time in which a car without a leader reaches the speed that was recorded at its
    place [s].
    """

    road: "RecordedRoad"
    recorded_states: State

    def change_lane_policy(self) -> None:
        """Change towards the lane of the recorded vehicle, if there is room.

        A change that is going on comes first.
        """
        # The lane beside, on the side where the recorded vehicle soon was.
        centres = self.road.straight.centres
        x, _, _, speed = self.road.states[self]
        x_soon = x + self.lane_change_time * speed
        places = self.recorded_states[:, 0]
        soon = min(int(np.searchsorted(places, x_soon)), len(places) - 1)
        offset = self.recorded_states[soon, 1] - centres[self.lane_index]
        start, end, lane = self.lane_index
        side = int(np.sign(round(offset / self.road.straight.lane_width)))
        beside = (start, end, lane + side)

        is_in_target_lane = self.lane_index == self.target_lane_index
        if not is_in_target_lane or beside == self.lane_index or beside not in centres:
            return
        neighbours = self.road.neighbour_vehicles(self, beside)
        if all(self._leaves_room(other) for other in neighbours):
            self.target_lane_index = beside

    def _leaves_room(self, other: Vehicle | None) -> bool:
        """Return whether a vehicle in the lane beside leaves room for a change."""
        if other is None:
            return True
        own_state = self.road.states[self]
        distance, _, _, relative_speed = self.road.states[other] - own_state
        gap = abs(distance) - (other.LENGTH + self.LENGTH) / 2
        closing_speed = max(-np.sign(distance) * relative_speed, 0.0)
        return bool(gap > self.road.entry_gap + self.gap_time * closing_speed)

    def acceleration(
        self,
        ego_vehicle: Vehicle,
        front_vehicle: RoadObject | None = None,
        rear_vehicle: object = None,
    ) -> float:
        """Return the acceleration of a vehicle behind another one [m/s^2].

        With a leader, it is that of `FollowingVehicle`.
        """
        if front_vehicle:
            return super().acceleration(ego_vehicle, front_vehicle)
        x, _, _, speed = self.road.states[self]
        places = self.recorded_states[:, 0]
        recorded_speed = np.interp(x, places, self.recorded_states[:, 3])
        return float(recorded_speed - speed) / self.speed_time


VEHICLE_TYPES = {
    "learned": LearnedVehicle,
    "replay": ReplayedVehicle,
    "idm": IDMVehicle,
}
"""Types of the vehicles that drive in lanes, by the kind of traffic."""


class RecordedRoad(Road):
    """A road for the vehicles of a recording.

    Only the ego collides: where its body overlaps another one. Vehicles enter where and
    when they were recorded to enter. Vehicles that are not replayed wait until the
    place is free, and leave at the end of the road.

    Args:
        recording: of the traffic.
        begin: step of the recording at which the road begins.
        left_out: number of the track that the ego replaces; None for no track.
        traffic: what moves the vehicles that drive in lanes, see `VEHICLE_TYPES`; all
            else is replayed.
        np_random: for drivers that draw random numbers.

    Attributes:
        straight: the same road, straightened.
        now: the present step of the recording.
        coming: tracks of the vehicles that have not entered yet.
    """

    entry_gap: ClassVar[float] = 2.0
    """Length that must be free ahead of and behind a vehicle that enters or changes
    lanes [m].
    """
    exit_distance: ClassVar[float] = 30.0
    """Distance past the end of the road at which vehicles leave it [m]."""
    lane_tolerance: ClassVar[float] = 0.3
    """Distance beyond the edge of a lane within which the middle of a vehicle still
    counts as in the lane [m].
    """

    vehicles: list[Vehicle]

    def __init__(
        self,
        recording: TrafficRecording,
        begin: int,
        left_out: int | None,
        traffic: str,
        np_random: np.random.Generator,
    ) -> None:
        self.straight = straight_road(recording)
        super().__init__(self.straight.network, np_random=np_random)
        self.begin = begin
        self.now = begin
        self._driving_type = VEHICLE_TYPES[traffic]
        self._states: dict[Vehicle, Car] = {}
        self._states_key: tuple[object, ...] = ()
        self.coming = [
            track
            for track in recording.tracks
            if track.number != left_out and track.last >= begin
        ]
        self._let_enter()

    @property
    def waiting(self) -> list[RecordedTrack]:
        """Tracks of the vehicles whose time has come, but whose place is taken."""
        return [track for track in self.coming if track.first <= self.now]

    @property
    def others(self) -> list[Vehicle]:
        """The vehicles of the recording, each with its ``track``: all but the ego."""
        return [vehicle for vehicle in self.vehicles if hasattr(vehicle, "track")]

    @property
    def states(self) -> dict[Vehicle, Car]:
        """States of all vehicles on the straight road, computed once in a step."""
        key = (self.now, *self.vehicles)
        if self._states_key != key:
            states = self.straight.states(states_of(self.vehicles))
            self._states = dict(zip(self.vehicles, states, strict=True))
            self._states_key = key
        return self._states

    def neighbour_vehicles(
        self,
        vehicle: Vehicle,
        lane_index: LaneIndex | None = None,
    ) -> tuple[Vehicle | None, Vehicle | None]:
        """Return the nearest vehicles ahead and behind in a lane, None without one.

        The lanes before and after it belong to it. By default, it is the lane of the
        vehicle.
        """
        vehicles = list(self.states)
        x, y, _, _ = np.array(list(self.states.values())).T
        centre = self.straight.centres[lane_index or vehicle.lane_index]
        half_width = self.straight.lane_width / 2 + self.lane_tolerance
        in_lane = np.abs(y - centre) < half_width
        distances = x - self.states[vehicle][0]
        ahead, is_ahead = nearest_ahead(distances, in_lane)
        behind, is_behind = nearest_ahead(-distances, in_lane)
        vehicle_ahead = vehicles[ahead] if is_ahead else None
        vehicle_behind = vehicles[behind] if is_behind else None
        return vehicle_ahead, vehicle_behind

    def step(self, dt: float) -> None:
        """Move all vehicles for ``dt`` seconds, and let vehicles enter and leave."""
        for vehicle in self.vehicles:
            vehicle.step(dt)
        self.now += 1
        for vehicle in self.others:
            if self._has_left(vehicle):
                self.vehicles.remove(vehicle)
        self._let_enter()

        # Collisions of the ego: the only vehicle without a track.
        for ego in self.vehicles:
            if hasattr(ego, "track"):
                continue
            for other in self.others:
                if overlap(ego, other):
                    ego.crashed = True
                    other.crashed = True

    def recorded(self, track: RecordedTrack) -> State:
        """Return the states of a track in each step until its end.

        They begin with the road, or with the track.
        """
        steps = np.arange(max(track.first, self.begin), track.last + 1)
        return self.straight.axes.states(track.at(steps))

    def _let_enter(self) -> None:
        """Let the vehicles enter whose time has come.

        Replayed vehicles enter even where another vehicle is, and so do all vehicles at
        the beginning.
        """
        is_beginning = self.now == self.begin
        for track in self.waiting:
            vehicle = self._vehicle_of(track)
            needs_no_room = is_beginning or isinstance(vehicle, ReplayedVehicle)
            if needs_no_room or self._has_room(vehicle):
                self.vehicles.append(vehicle)
                self.coming.remove(track)

    def _vehicle_of(self, track: RecordedTrack) -> Vehicle:
        """Return a vehicle in the first state of a track that it has on this road."""
        states = self.recorded(track)
        # Any: the types take different arguments, and highway-env's has no types.
        kind: Any = self._driving_type if track.drives else ReplayedVehicle
        if kind is ReplayedVehicle:
            vehicle = ReplayedVehicle(self, states)
        else:
            x, y, heading, speed = states[0].tolist()
            vehicle = kind(self, [x, y], heading, speed)
        set_size(vehicle, track.size)
        vehicle.track = track
        vehicle.check_collisions = False
        vehicle.follows_lanes = track.drives

        # Places along the road must not decrease: they are searched and interpolated.
        vehicle.recorded_states = self.straight.states_of_track(track)
        places = vehicle.recorded_states[:, 0]
        vehicle.recorded_states[:, 0] = np.maximum.accumulate(places)

        if kind is LearnedVehicle:
            vehicle.target_speed = TrafficRecording.default_speed_limit
        else:
            vehicle.target_speed = max(float(track.samples[:, 4].max()), 1.0)
        return vehicle

    def _has_room(self, vehicle: Vehicle) -> bool:
        """Return whether a vehicle that enters keeps the entry gap to all others."""
        with_gaps = copy(vehicle)
        set_size(with_gaps, (vehicle.LENGTH + 2 * self.entry_gap, vehicle.WIDTH))
        return not any(overlap(with_gaps, other) for other in self.vehicles)

    def _has_left(self, vehicle: Vehicle) -> bool:
        """Return whether a vehicle is past the end of the road or of its replay."""
        if isinstance(vehicle, ReplayedVehicle):
            return vehicle.track.last < self.now
        place, _ = vehicle.lane.local_coordinates(vehicle.position)
        exit_place = vehicle.lane.length + self.exit_distance
        end = vehicle.lane_index[1]
        return place > exit_place and not self.network.graph.get(end)


def set_size(item: RoadObject, size: tuple[float, float]) -> None:
    """Give an object on a road a length and a width [m]."""
    length, width = size
    item.LENGTH = float(length)
    item.WIDTH = float(width)
    item.diagonal = float(np.hypot(length, width))


def overlap(one: RoadObject, other: RoadObject) -> bool:
    """Return whether the bodies of two objects on a road overlap."""
    own_pose = (*one.position, one.heading)
    other_pose = (*other.position, other.heading)
    own_size = (one.LENGTH, one.WIDTH)
    other_size = (other.LENGTH, other.WIDTH)
    return bool(separation(own_pose, own_size, other_pose, other_size) < 0)
