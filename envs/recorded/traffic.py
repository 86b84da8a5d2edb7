"""Move the others in recorded traffic: as they went, as learned drivers, or by highway-env's IDM and MOBIL."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from highway_env.road.road import Road
from highway_env.utils import are_polygons_intersecting
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.envs.recorded.network import Axes
from ms_highway.envs.recorded.scenario import SPEED_LIMIT, RecordedTrack, TrafficRecording
from ms_highway.envs.recorded.straight_road import States, StraightRoad
from ms_highway.game.learned_reward import shipped
from ms_highway.game.scenario import TIME_STEP
from ms_highway.planning.learned_driving import PAST, SECOND, moved, seen_states, shown_traits
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.vehicle.lane_paths import from_heading

ROOM = 16  # cars: arrays grow by so many, so that few numbers of cars compile anew
BEYOND = 30.0  # m behind the end of the road, where cars leave it
CLEAR = 2.0  # m, to who is where a car enters, and at least between cars in the lane that one changes to
CLOSING = 1.0  # s, for which a faster car behind has to fit into the gap besides
LOOK_AHEAD = 2.0  # s, after which a car will be in the lane that it was recorded in, if it begins to change now
FORCED = 40.0  # m before the end of a lane, from which who has to leave it cares for no one behind
SETTLING = 1.0  # s, in which who has nobody ahead goes as fast as it was recorded there
STOPPED = 1.0  # m, gap that is kept to who stands ahead
CALM, HARDEST = 1.5, 8.0  # m/s^2, of braking that is left to what was learned, and of any
BEGUN = 0.3  # m towards a lane, from which a change to it is not given up
NO_TIME = np.zeros(2)


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


class IdmDriver(IDMVehicle):
    """A vehicle that highway-env's IDM and MOBIL drive."""

    number: int


class Traffic(ABC):
    """The others on a road, from a step of a recording on.

    Attributes:
        tracks: of those that may be there.
        waiting: numbers of those that should have entered, but found somebody in their place.
    """

    vehicle_type: ClassVar[type[Vehicle]] = RecordedVehicle

    def __init__(
        self, scenario: TrafficRecording, straight: StraightRoad, axes: Axes, road: Road, left_out: int | None
    ) -> None:
        """Prepare traffic.

        Args:
            scenario: the recording.
            straight: its road, straightened.
            axes: of the road in highway-env.
            road: of highway-env.
            left_out: number of the track whose place the ego takes; None for all.
        """
        self.straight, self.axes, self.road = straight, axes, road
        self.tracks = tuple(track for track in scenario.tracks if track.number != left_out)
        self._left_out = tuple(track for track in scenario.tracks if track.number == left_out)
        self.vehicles: dict[int, Vehicle] = {}  # by the place of their track
        self.waiting: tuple[int, ...] = ()
        self._entered: set[int] = set()

    @property
    def egos(self) -> list[Vehicle]:
        """Vehicles on the road that are none of its own."""
        own = set(map(id, self.vehicles.values()))
        return [vehicle for vehicle in self.road.vehicles if id(vehicle) not in own]

    def begin(self, step: int) -> None:
        """Put those on the road who are there at a step."""
        self.step = step
        for place, track in enumerate(self.tracks):
            if track.samples[0, 0] <= step <= track.samples[-1, 0]:
                self._enter(place, step)
            elif track.samples[-1, 0] < step:
                self._entered.add(place)

    @abstractmethod
    def move(self) -> None:
        """Move those on the road for a step, let those leave who have reached its end, and others enter."""

    def _move_on(self, leaves: Any) -> None:
        """Count the step, and let vehicles leave and enter."""
        self.step += 1
        for place in [place for place in self.vehicles if leaves(place)]:
            self.road.vehicles.remove(self.vehicles.pop(place))
        waiting = []
        for place, track in enumerate(self.tracks):
            if place not in self._entered and track.samples[0, 0] <= self.step:
                if self._is_free(track):
                    self._enter(place)
                else:
                    waiting.append(track.number)
        self.waiting = tuple(waiting)

    def _is_free(self, track: RecordedTrack) -> bool:
        """Return whether nobody is in the place where a track begins, nor right before or behind it."""
        _, x, y, orientation, _ = track.samples[0]
        heading, (length, width) = float(self.axes.headings(orientation)), track.size
        apart = np.array([other.position for other in self.road.vehicles]) - self.axes.positions([x, y])
        ahead, aside = from_heading(heading, *apart.T)
        lengths, widths = np.array([(other.LENGTH, other.WIDTH) for other in self.road.vehicles]).T
        along, across = np.abs(ahead) - (lengths + length) / 2, np.abs(aside) - (widths + width) / 2
        return not bool(((along < CLEAR) & (across < 0)).any())

    def _enter(self, place: int, step: float | None = None) -> None:
        """Put the vehicle of a track on the road where it was at a step, by default the first of the track."""
        track = self.tracks[place]
        x, y, orientation, speed = sampled(track, float(track.samples[0, 0]) if step is None else step)
        position, heading = self.axes.positions([x, y]), float(self.axes.headings(orientation))
        vehicle = self.vehicle_type(self.road, position, heading, speed)
        vehicle.number, vehicle.check_collisions = track.number, False
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
        self._move_on(lambda place: self.tracks[place].samples[-1, 0] <= self.step - 1)
        for place, vehicle in self.vehicles.items():
            x, y, orientation, speed = sampled(self.tracks[place], self.step)
            vehicle.put(self.axes.positions([x, y]), self.axes.headings(orientation), speed)

    def _is_free(self, track: RecordedTrack) -> bool:
        return True


class Idm(Traffic):
    """highway-env's IDM and MOBIL drive, each at most as fast as it was recorded."""

    vehicle_type = IdmDriver

    def move(self) -> None:
        """Let those leave who have reached the end of the road, and others enter; vehicles move by themselves."""
        self._move_on(lambda place: _is_beyond(self.vehicles[place], self.straight, self.axes))

    def _enter(self, place: int, step: float | None = None) -> None:
        super()._enter(place, step)
        vehicle, fastest = self.vehicles[place], float(self.tracks[place].samples[:, 4].max())
        vehicle.target_speed = max(fastest, 1.0)


def _is_beyond(vehicle: Vehicle, straight: StraightRoad, axes: Axes) -> bool:
    x = straight.coordinates.locate(axes.points(vehicle.position)[None]).x[0]
    return bool(x > straight.coordinates.length + BEYOND)


@dataclass(frozen=True)
class Recorded:
    """What a driver was recorded to do, by the way along the road.

    Attributes:
        x: along the straight road, ascending [m].
        lane: number of the lane.
        speed: [m/s].
    """

    x: np.ndarray
    lane: np.ndarray
    speed: np.ndarray


class Learned(Traffic):
    """Learned drivers, who react to the ego and to each other, by the traits that each shows in its first second.

    They change lanes where they were recorded to, as soon as there is room. Who has nobody ahead in sight goes as fast
    as it was recorded at that place: those ahead of it were not recorded.
    """

    def begin(self, step: int) -> None:
        """Put those on the road who are there at a step, with their traits."""
        super().begin(step)
        drivers = shipped("us101").drivers
        assert drivers is not None  # the package's own file
        self.drivers = drivers.bare
        straight, count = self.straight, len(self.tracks) + 1
        self.count = count + -count % ROOM
        sizes = np.ones((self.count, 2))
        for place, track in enumerate((*self.tracks, *self._left_out)):
            sizes[place] = track.size
        self.surroundings = _Lanes(sizes, straight.lane_width, SPEED_LIMIT)
        paths = [straight.path(track) for track in self.tracks]
        self.recorded = [self._recorded(path) for path in paths]
        self.traits = self._shown_traits(paths)

    def _shown_traits(self, paths: list[States]) -> np.ndarray:
        """Return what each driver is like, by its first second among all who were recorded then."""
        everyone, traits = [*self.tracks, *self._left_out], np.zeros((self.count, 3), np.float32)
        for first in {int(track.samples[0, 0]) for track in self.tracks}:
            past = np.full((PAST + 1, self.count, 4), np.nan, np.float32)
            for place, track in enumerate(everyone):
                path = paths[place] if place < len(paths) else self.straight.path(track)
                steps = track.samples[:, 0].astype(int) - first
                then = (steps >= 0) & (steps <= SECOND)
                past[PAST - SECOND + steps[then], place] = path[then]
            shown = np.asarray(_shown(self.drivers, self.surroundings, past))
            begun = [place for place, track in enumerate(self.tracks) if int(track.samples[0, 0]) == first]
            traits[begun] = shown[begun]
        return traits

    def _recorded(self, path: States) -> Recorded:
        x = np.maximum.accumulate(path[:, 0]) + 1e-6 * np.arange(len(path))
        lane = np.rint(path[:, 1] / self.straight.lane_width).clip(0, len(self.straight.centres) - 1)
        return Recorded(x, lane.astype(int), path[:, 3])

    def move(self) -> None:
        """Move those on the road for a step, let those leave who have reached its end, and others enter."""
        states = self._states()
        side, wanted = self._wishes(states)
        given = self.drivers, self.surroundings, self.traits
        after, led = _driven(*given, side, wanted, states)
        if side.any():  # who changes lanes minds who is ahead in its own, too
            kept, behind = _driven(*given, np.zeros_like(side), wanted, states)
            slower = behind & (kept[:, 3] < after[:, 3])
            after[slower, 0], after[slower, 3] = kept[slower, 0], kept[slower, 3]
            led |= slower
        most = np.full(self.count, np.inf)
        for place in [place for place in self.vehicles if not led[place]]:
            own, (x, _, _, speed) = self.recorded[place], states[place]
            most[place] = speed + (np.interp(x, own.x, own.speed) - speed) * TIME_STEP / SETTLING
        _slow_down(after, most)
        places = list(self.vehicles)
        points, orientations = self.straight.bend(after[places].astype(float))
        for place, point, orientation in zip(
            places, self.axes.positions(points), self.axes.headings(orientations), strict=True
        ):
            self.vehicles[place].put(point, orientation, after[place, 3])
        end = self.straight.coordinates.length + BEYOND
        self._move_on(lambda place: after[place, 0] > end)

    def _states(self) -> States:
        """Return the states on the straight road of all cars, the ego's after them; NaN where there is none."""
        states = np.full((self.count, 4), np.nan, np.float32)
        egos = self.egos
        places = [*self.vehicles, *range(len(self.tracks), len(self.tracks) + len(egos))]
        everyone = [*self.vehicles.values(), *egos]
        states[places] = self.straight.straighten(
            self.axes.points([vehicle.position for vehicle in everyone]),
            self.axes.orientations([vehicle.heading for vehicle in everyone]),
            np.array([vehicle.speed for vehicle in everyone]),
        )
        for place, ego in zip(places[len(self.vehicles) :], egos, strict=True):
            self.surroundings.sizes[place] = ego.LENGTH, ego.WIDTH
        return states

    def _wishes(self, states: States) -> tuple[np.ndarray, np.ndarray]:
        """Return how many lanes to the right each changes now, and the middle of the lane that it wants."""
        width, last = self.straight.lane_width, len(self.straight.centres) - 1
        lanes = np.rint(np.nan_to_num(states[:, 1]) / width).clip(0, last).astype(int)
        side = np.zeros(self.count, dtype=np.int32)
        for place in self.vehicles:
            own, (x, y, _, speed), lane = self.recorded[place], states[place], lanes[place]
            later = min(int(np.searchsorted(own.x, x + LOOK_AHEAD * speed)), len(own.x) - 1)
            wish = int(np.sign(own.lane[later] - lane))
            begun = wish * (y - lane * width) > BEGUN
            if wish and (begun or self._has_room(states, place, lane, lane + wish)):
                side[place] = wish
        return side, ((lanes + side) * width).astype(np.float32)

    def _has_room(self, states: States, place: int, lane: int, other: int) -> bool:
        """Return whether there is room for a driver in another lane."""
        x, _, _, speed = states[place]
        inside = np.abs(states[:, 1] - other * self.straight.lane_width) < self.straight.lane_width / 2 + BEGUN
        inside[place] = False
        ahead, lengths = states[:, 0] - x, (self.surroundings.sizes[:, 0] + self.surroundings.sizes[place, 0]) / 2
        forced = self.straight.lane_ends(lane, x) < FORCED
        closing = np.where(ahead > 0, speed - states[:, 3], states[:, 3] - speed)
        needed = CLEAR + CLOSING * np.maximum(closing, 0.0) * (0.0 if forced else 1.0)
        return not bool((inside & (np.abs(ahead) - lengths < needed)).any())


class _Lanes(NamedTuple):
    """What learned drivers drive in, see `ms_highway.planning.learned_driving.Surroundings`."""

    sizes: np.ndarray
    lane_width: float
    speed_limit: float


def _driven(*given: Any) -> tuple[States, np.ndarray]:
    """Return all states after a step, and who has a leader; who would run into it brakes as hard as it has to.

    What is learned in dense traffic does not stop behind who stands.
    """
    states = given[-1]
    after, leader = jax.tree.map(np.array, _moved(*given))
    speed, gap = states[:, 3], np.maximum(leader.gap - STOPPED, 0.1)
    needed = np.where(leader.there, (speed**2 - np.maximum(leader.speed, 0.0) ** 2) / (2 * gap), 0.0)
    slowest = np.where(needed > CALM, speed - np.minimum(needed, HARDEST) * TIME_STEP, np.inf)
    touching = leader.there & (leader.gap < STOPPED)
    slowest = np.where(touching, np.maximum(leader.speed, speed - HARDEST * TIME_STEP), slowest)
    _slow_down(after, slowest)
    return after, leader.there


def _slow_down(after: States, most: np.ndarray) -> None:
    """Let cars be at most so fast after a step, never backwards, and less far along the road."""
    less = np.minimum(np.maximum(most, 0.0), after[:, 3]) - after[:, 3]
    after[:, 0] += less * TIME_STEP / 2
    after[:, 3] += less


_moved = jit_quickly(
    lambda drivers, around, traits, side, wanted, states: moved(
        drivers, around, traits, side, wanted, seen_states(states)
    )
)
_shown = jit_quickly(shown_traits)


TRAFFIC: dict[str, type[Traffic]] = {"learned": Learned, "replay": Replay, "idm": Idm}
"""Kinds of traffic by name."""


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
    if np.linalg.norm(one.position - other.position) > (one.diagonal + other.diagonal) / 2:
        return False
    return bool(are_polygons_intersecting(one.polygon(), other.polygon(), NO_TIME, NO_TIME)[0])
