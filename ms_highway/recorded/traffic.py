"""Move the others in recorded traffic: what all kinds share, who goes as it went, and highway-env's IDM and MOBIL."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.geometry.curve import rotated
from ms_highway.recorded.scenario import RecordedTrack, TrafficRecording
from ms_highway.recorded.straight_road import StraightRoad

BEYOND = 30.0  # m behind the end of the road, where cars leave it
CLEAR = 2.0  # m, to who is where a car enters, and at least between cars in the lane that one changes to


class RecordedVehicle(Vehicle):
    """A vehicle that its traffic moves."""

    number: int

    def act(self, action: Any = None) -> None:
        """Do nothing: the traffic decides."""

    def step(self, dt: float) -> None:
        """Do nothing: the traffic has moved it."""

    def put(self, position: np.ndarray, heading: float, speed: float) -> None:
        """Put it somewhere."""
        self.position, self.heading, self.speed = np.array(position), float(heading), float(speed)
        self.on_state_update()


class Traffic(ABC):
    """The others on a road, from a step of a recording on.

    Attributes:
        tracks: of those that may be there.
        waiting: numbers of those that should have entered, but found somebody in their place.
    """

    vehicle_type: ClassVar[type] = RecordedVehicle

    def __init__(
        self,
        scenario: TrafficRecording,
        straight: StraightRoad,
        road: Road,
        left_out: int | None,
        step: int,
    ) -> None:
        """Put the vehicles on the road that were recorded there at a step.

        Args:
            scenario: the recording.
            straight: its road, straightened.
            road: of highway-env.
            left_out: number of the track whose place the ego takes; None for all.
            step: of the recording.
        """
        self.step = step
        self.straight, self.axes, self.road = straight, straight.axes, road
        self.tracks = tuple(track for track in scenario.tracks if track.number != left_out)
        self.everyone = *self.tracks, *(track for track in scenario.tracks if track.number == left_out)
        self.vehicles: dict[int, Vehicle] = {}  # by the place of their track
        self.waiting: tuple[int, ...] = ()
        self._entered: set[int] = set()
        for place, track in enumerate(self.tracks):
            if track.last < step:
                self._entered.add(place)
            elif track.first <= step:
                self._enter(place, step)

    @property
    def egos(self) -> list[Vehicle]:
        """Vehicles on the road that are none of its own."""
        return [vehicle for vehicle in self.road.vehicles if vehicle not in self.vehicles.values()]

    @property
    def end(self) -> float:
        """Where cars leave the road, along it [m]."""
        return self.straight.curve.end + BEYOND

    @abstractmethod
    def move(self) -> None:
        """Move those on the road for a step, let those leave who have reached its end, and others enter."""

    def _is_replayed(self, track: RecordedTrack) -> bool:
        """Return whether a track is replayed, as all pedestrians and other road users outside lanes are."""
        return not track.drives

    def _move_on(self, leaves: Callable[[int], bool]) -> None:
        """Count the step, let vehicles leave and enter, and move replayed vehicles."""
        self.step += 1
        for place in list(self.vehicles):
            track = self.tracks[place]
            if track.last < self.step if self._is_replayed(track) else leaves(place):
                self.road.vehicles.remove(self.vehicles.pop(place))
        self.waiting = ()
        for place, track in enumerate(self.tracks):
            if place not in self._entered and track.first <= self.step:
                if self._is_replayed(track) or self._is_free(track):
                    self._enter(place, track.first)
                else:
                    self.waiting += (track.number,)
        for place, vehicle in self.vehicles.items():
            if self._is_replayed(self.tracks[place]):
                *pose, speed = sampled(self.tracks[place], self.step)
                vehicle.put(*self.axes.pose(*pose), speed)

    def _is_free(self, track: RecordedTrack) -> bool:
        """Return whether nobody is in the place where a track begins, nor right before or behind it."""
        position, heading = self.axes.pose(*track.samples[0, 1:4])
        for other in self.road.vehicles:
            x, y = other.position - position
            ahead, aside = rotated(x, y, heading)
            length, width = (other.LENGTH + track.size[0]) / 2, (other.WIDTH + track.size[1]) / 2
            if abs(ahead) - length < CLEAR and abs(aside) < width:
                return False
        return True

    def _enter(self, place: int, step: int) -> None:
        """Put the vehicle of a track on the road where it was at a step."""
        track = self.tracks[place]
        *pose, speed = sampled(track, step)
        kind = RecordedVehicle if self._is_replayed(track) else self.vehicle_type
        vehicle = kind(self.road, *self.axes.pose(*pose), speed)
        vehicle.number, vehicle.check_collisions, vehicle.follows_lanes = track.number, False, track.drives
        sized(vehicle, track.size)
        self.road.vehicles.append(vehicle)
        self.vehicles[place] = vehicle
        self._entered.add(place)


def sized(item: RoadObject, size: tuple[float, float]) -> None:
    """Give something on a road a length and a width [m]."""
    item.LENGTH, item.WIDTH = map(float, size)
    item.diagonal = float(np.hypot(*size))


def sampled(track: RecordedTrack, step: float) -> np.ndarray:
    """Return x, y, orientation and speed of a track at a step, interpolated where it was not seen."""
    times, x, y, orientation, speed = track.samples.T
    return np.array([np.interp(step, times, part) for part in (x, y, np.unwrap(orientation), speed)])


class Replay(Traffic):
    """Everybody goes where it went, whatever the ego does."""

    def move(self) -> None:
        """Move those on the road for a step, and let others leave and enter as they were recorded to."""
        self._move_on(lambda _: False)

    def _is_replayed(self, track: RecordedTrack) -> bool:
        return True


class Idm(Traffic):
    """highway-env's IDM and MOBIL drive, each at most as fast as it was recorded."""

    vehicle_type = IDMVehicle

    def move(self) -> None:
        """Let those leave who have reached the end of the road, and others enter; vehicles move by themselves."""
        self._move_on(lambda place: self.straight.along(self.vehicles[place]) > self.end)

    def _enter(self, place: int, step: int) -> None:
        super()._enter(place, step)
        self.vehicles[place].target_speed = max(float(self.tracks[place].samples[:, 4].max()), 1.0)


class RecordedRoad(Road):
    """A road on which traffic moves the others, and only the egos collide, where their bodies overlap."""

    traffic: Traffic

    def step(self, dt: float) -> None:
        """Move everybody for ``dt`` seconds, and let others enter and leave."""
        before = list(self.vehicles)
        self.traffic.move()
        for vehicle in before:
            vehicle.step(dt)
        for ego in self.traffic.egos:
            for other in (*self.vehicles, *self.objects):
                if other is not ego and overlap(ego, other):
                    ego.crashed = other.crashed = True


def overlap(one: RoadObject, other: RoadObject) -> bool:
    """Return whether the bodies of two things on a road overlap."""
    return bool(RoadObject._is_colliding(one, other, 0.0)[0])
