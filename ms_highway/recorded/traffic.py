"""Let the vehicles of a recording enter a road, drive there and leave it: replayed, by
learned drivers, or by IDM.
"""

from copy import copy
from typing import Any

import numpy as np
from highway_env.road.road import LaneIndex, Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.geometry.bodies import nearest_ahead, separation
from ms_highway.recorded.scenario import SPEED_LIMIT, RecordedTrack, TrafficRecording
from ms_highway.recorded.straight_road import straight_road
from ms_highway.runtime.arrays import State
from ms_highway.vehicle import FollowingVehicle, RoutedVehicle, states_of

EXIT_DISTANCE = 30.0  # m past the end of the road, where vehicles leave it
# m that must be free ahead of and behind a vehicle that enters or changes lanes
ENTRY_GAP = 2.0
# m beyond the edge of a lane, within which the middle of a vehicle still counts as in
# the lane
LANE_TOLERANCE = 0.3
# s, for which a gap in the lane beside must stay long enough at the present speeds
GAP_TIME = 1.0
# s, of a lane change: it begins this long before the recorded vehicle was in the other
# lane
LOOK_AHEAD = 2.0
# s, in which a car without a leader reaches the speed that was recorded at its place
SPEED_TIME = 1.0


class ReplayedVehicle(RoutedVehicle):
    """A vehicle that moves as it was recorded, in highway-env's colours."""

    COLOR = None


class LearnedVehicle(FollowingVehicle):
    """A learned driver in the place of a recorded vehicle.

    It changes lanes where the recorded vehicle did, as soon as there is room. Without a
    leader it drives as fast as the recorded vehicle at the same place, whose leader was
    out of sight of the recording.

    Attributes:
        way: states of the recorded vehicle on the straight road [times, 4].
    """

    road: "RecordedRoad"
    way: State

    def change_lane_policy(self) -> None:
        """Change towards the lane of the recorded vehicle, unless a change is going on
        or there is no room for one.
        """
        straight, (start, end, lane) = self.road.straight, self.lane_index
        x, *_, speed = self.road.states[self]
        later = min(
            int(np.searchsorted(self.way[:, 0], x + LOOK_AHEAD * speed)),
            len(self.way) - 1,
        )
        aside = self.way[later, 1] - straight.centres[self.lane_index]
        beside = start, end, lane + int(np.sign(round(aside / straight.lane_width)))
        may_change = (
            self.lane_index == self.target_lane_index != beside
            and beside in straight.centres
        )
        if may_change and all(
            map(self._leaves_room, self.road.neighbour_vehicles(self, beside))
        ):
            self.target_lane_index = beside

    def _leaves_room(self, other: Vehicle | None) -> bool:
        """Return whether a vehicle in the lane beside leaves room for a change to that
        lane.
        """
        if other is None:
            return True
        distance, _, _, relative_speed = (
            self.road.states[other] - self.road.states[self]
        )
        gap = abs(distance) - (other.LENGTH + self.LENGTH) / 2
        return bool(
            gap > ENTRY_GAP + GAP_TIME * max(-np.sign(distance) * relative_speed, 0.0)
        )

    def acceleration(
        self, ego_vehicle: Any, front_vehicle: Any = None, rear_vehicle: Any = None
    ) -> float:
        """Return the acceleration of a vehicle behind another one [m/s^2], see
        `FollowingVehicle`.
        """
        if front_vehicle:
            return super().acceleration(ego_vehicle, front_vehicle)
        x, *_, speed = self.road.states[self]
        return float(np.interp(x, self.way[:, 0], self.way[:, 3]) - speed) / SPEED_TIME


class RecordedRoad(Road):
    """A road for the vehicles of a recording. Only the ego collides: where its body
    overlaps another one.

    Vehicles enter where and when they were recorded to enter. Vehicles that are not
    replayed wait until the place is free, and leave at the end of the road.

    Args:
        recording: of the traffic.
        begin: step of the recording at which the road begins.
        left_out: number of the track that the ego replaces; None for no track.
        traffic: what moves the vehicles that drive in lanes: ``"replay"``,
            ``"learned"`` or ``"idm"``; all else is replayed.
        np_random: for drivers that draw random numbers.

    Attributes:
        straight: the same road, straightened.
        now: the present step of the recording.
        coming: tracks of the vehicles that have not entered yet.
    """

    vehicles: list[Any]

    def __init__(
        self,
        recording: TrafficRecording,
        begin: int,
        left_out: int | None,
        traffic: str,
        np_random: Any,
    ) -> None:
        self.straight = straight_road(recording)
        super().__init__(self.straight.network, np_random=np_random)
        self.begin = begin
        self.now = begin
        self._driver = VEHICLES[traffic]
        self._computed: tuple[tuple, dict[Vehicle, State]] = ((), {})
        self.coming = [
            track
            for track in recording.tracks
            if track.number != left_out and track.last >= begin
        ]
        self._let_enter()

    @property
    def waiting(self) -> list[RecordedTrack]:
        """Tracks of the vehicles that should have entered, but whose place is taken by
        another vehicle.
        """
        return [track for track in self.coming if track.first <= self.now]

    @property
    def others(self) -> list[Any]:
        """The vehicles of the recording, each with its ``track``: all but the ego."""
        return [vehicle for vehicle in self.vehicles if hasattr(vehicle, "track")]

    @property
    def states(self) -> dict[Vehicle, State]:
        """States of all vehicles on the straight road, computed once in a step."""
        when = self.now, *self.vehicles
        if self._computed[0] != when:
            states = self.straight.states(states_of(self.vehicles))
            self._computed = when, dict(zip(self.vehicles, states, strict=True))
        return self._computed[1]

    def neighbour_vehicles(
        self, vehicle: Vehicle, lane_index: LaneIndex | None = None
    ) -> tuple[Any, Any]:
        """Return the nearest vehicles ahead and behind, None without one: in a lane and
        the lanes before and after it.

        By default, that is the lane of the vehicle.
        """
        vehicles, (x, y, *_) = [*self.states], np.array([*self.states.values()]).T
        centre = self.straight.centres[lane_index or vehicle.lane_index]
        inside = np.abs(y - centre) < self.straight.lane_width / 2 + LANE_TOLERANCE
        found = [
            nearest_ahead(sign * (x - self.states[vehicle][0]), inside)
            for sign in (1, -1)
        ]
        ahead, behind = (vehicles[place] if there else None for place, there in found)
        return ahead, behind

    def step(self, dt: float) -> None:
        """Move all vehicles for ``dt`` seconds, and let vehicles enter and leave."""
        for vehicle in self.vehicles:
            vehicle.step(dt)
        self.now += 1
        for vehicle in filter(self._has_left, self.others):
            self.vehicles.remove(vehicle)
        self._let_enter()
        for ego in [
            vehicle for vehicle in self.vehicles if not hasattr(vehicle, "track")
        ]:
            for other in self.others:
                if overlap(ego, other):
                    ego.crashed = other.crashed = True

    def recorded(self, track: RecordedTrack) -> State:
        """Return the states of a track in each step from the beginning of the road, or
        from its own, until its end.
        """
        steps = np.arange(max(track.first, self.begin), track.last + 1)
        return self.straight.axes.states(track.at(steps))

    def _let_enter(self) -> None:
        """Let the vehicles enter whose time has come.

        Replayed vehicles enter even where another vehicle is, and so do all vehicles at
        the beginning.
        """
        for track in self.waiting:
            kind: Any = self._driver if track.drives else ReplayedVehicle
            replayed = kind is ReplayedVehicle
            states = self.recorded(track)
            *position, heading, speed = states[0].tolist()
            vehicle = sized(
                (
                    kind(self, states)
                    if replayed
                    else kind(self, position, heading, speed)
                ),
                track.size,
            )
            vehicle.track = track
            vehicle.check_collisions = False
            vehicle.follows_lanes = track.drives
            vehicle.way = self.straight.way(track)
            vehicle.way[:, 0] = np.maximum.accumulate(vehicle.way[:, 0])
            vehicle.target_speed = (
                SPEED_LIMIT
                if kind is LearnedVehicle
                else max(float(track.samples[:, 4].max()), 1.0)
            )
            with_room = sized(
                copy(vehicle), (vehicle.LENGTH + 2 * ENTRY_GAP, vehicle.WIDTH)
            )
            free = not any(overlap(with_room, other) for other in self.vehicles)
            if free or self.now == self.begin or replayed:
                self.vehicles.append(vehicle)
                self.coming.remove(track)

    def _has_left(self, vehicle: Any) -> bool:
        """Return whether a vehicle is past the end of its track if it is replayed,
        otherwise of the road.
        """
        if isinstance(vehicle, ReplayedVehicle):
            return vehicle.track.last < self.now
        place, _ = vehicle.lane.local_coordinates(vehicle.position)
        return (
            place > vehicle.lane.length + EXIT_DISTANCE
            and not self.network.graph.get(vehicle.lane_index[1])
        )


VEHICLES = {"learned": LearnedVehicle, "replay": ReplayedVehicle, "idm": IDMVehicle}
"""Types of the vehicles that drive in lanes, by the kind of traffic."""


def sized(item: RoadObject, size: tuple[float, float]) -> RoadObject:
    """Give an object on a road a length and a width [m], and return it."""
    item.LENGTH, item.WIDTH = map(float, size)
    item.diagonal = float(np.hypot(*size))
    return item


def overlap(one: RoadObject, other: RoadObject) -> bool:
    """Return whether the bodies of two objects on a road overlap."""
    own, theirs = ((*item.position, item.heading) for item in (one, other))
    return bool(
        separation(own, (one.LENGTH, one.WIDTH), theirs, (other.LENGTH, other.WIDTH))
        < 0
    )
