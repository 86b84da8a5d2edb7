"""Drive the vehicles of a recording as learned drivers, who react to the ego and to each other."""

from functools import cache, lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.learned_drivers import Drivers
from ms_highway.game.learned_reward import shipped
from ms_highway.game.neighbours import Leader
from ms_highway.game.scenario import TIME_STEP
from ms_highway.planning.learned_driving import (
    PAST,
    SECOND,
    Cars,
    States,
    Surroundings,
    moved,
    seen_states,
    shown_traits,
)
from ms_highway.recorded.scenario import KEPT, SPEED_LIMIT, RecordedTrack, TrafficRecording
from ms_highway.recorded.straight_road import map_of
from ms_highway.recorded.traffic import CLEAR, DrivenRoad, GuidedVehicle
from ms_highway.runtime.compilation import jit_quickly

ROOM = 16  # cars: arrays grow by so many, so that few numbers of cars compile anew
CLOSING = 1.0  # s, for which a gap in the lane beside has to be long enough at the present speeds
LOOK_AHEAD = 2.0  # s, after which a car will be in the lane that it was recorded in, if it begins to change now
SETTLING = 1.0  # s, in which a car without a leader becomes as fast as it was recorded at its place
STOPPED = 1.0  # m, gap to a standing leader
CALM, HARDEST = 1.5, 8.0  # m/s^2, of braking that is left to the learned reward, and of any braking
BEGUN = 0.3  # m, lateral progress after which a lane change is not given up


class RecordedWay(NamedTuple):
    """A track on the straight road.

    Attributes:
        x: places at which it was recorded, ascending [times, m].
        lanes: numbers of the lanes that it was in there [times].
        states: x, y, heading and speed [times, 4].
    """

    x: Float[np.ndarray, "times"]
    lanes: Int[np.ndarray, "times"]
    states: Float[np.ndarray, "times 4"]


class LearnedVehicle(GuidedVehicle):
    """A learned driver who follows a way. Its road computes the steps of all of them at once."""

    way: RecordedWay

    def wishes(self, x: float, lane: int, speed: float) -> tuple[float, float]:
        """Return the lane change that it wants (-1 left, 0 none, 1 right), and its speed without a leader [m/s]."""
        later = min(int(np.searchsorted(self.way.x, x + LOOK_AHEAD * speed)), len(self.way.x) - 1)
        return np.sign(self.way.lanes[later] - lane), np.interp(x, self.way.x, self.way.states[:, 3])


class Wishes(NamedTuple):
    """What drivers want besides what was learned of them.

    Attributes:
        lane: number of the lane that each is in.
        side: lanes to the right that it wants to change to, -1, 0 or 1.
        usual: speed without a leader [m/s].
    """

    lane: Cars
    side: Cars
    usual: Cars


class LearnedRoad(DrivenRoad):
    """A road on which learned drivers drive, by the traits that each shows in its first second.

    They change lanes where they were recorded to, as soon as there is room. A car that has nobody ahead in sight goes
    as fast as it was recorded at that place: those ahead of it were not recorded.
    """

    vehicle_type = LearnedVehicle

    def make(self, track: RecordedTrack) -> Any:
        """Return the vehicle of a track where it enters."""
        vehicle = super().make(track)
        vehicle.way = ways_of(self.recording)[track.number]
        return vehicle

    def act(self) -> None:
        """Let all vehicles decide what to do in the next step."""
        super().act()
        straight, traits, cars = map_of(self.recording).straight, traits_of(self.recording), self.vehicles
        around = _surroundings(self.recording)
        count = len(around.sizes)
        states, logarithms = np.full((count, 4), np.nan, np.float32), np.zeros((count, 3))
        wishes = Wishes(*np.zeros((3, count)))
        poses = straight.poses_of(cars)
        states[: len(cars)] = straight.states(poses, np.array([car.speed for car in cars]))
        wishes.lane[: len(cars)] = straight.numbers[poses.lane]
        for place, car in enumerate(cars):
            around.sizes[place] = car.LENGTH, car.WIDTH
            x, _, heading, speed = states[place]
            if isinstance(car, LearnedVehicle):
                wishes.side[place], wishes.usual[place] = car.wishes(x, wishes.lane[place], speed)
                logarithms[place] = traits[car.track.number]
            elif not getattr(car, "follows_lanes", True):  # such as a pedestrian, who crosses
                states[place, 3] *= max(np.cos(heading), 0.0)
        after = np.asarray(_driven(learned_drivers(), around, logarithms, wishes, states), float)
        for place, car in enumerate(cars):
            if isinstance(car, LearnedVehicle):
                _, _, heading, speed = after[place]
                pose = straight.moved(poses, place, after[place, :2] - states[place, :2], heading)
                car.coming = *pose, float(speed)


@lru_cache(KEPT)
def ways_of(recording: TrafficRecording) -> dict[int, RecordedWay]:
    """Return the ways of all tracks of a recording, by number."""
    axes, _, straight = map_of(recording)
    ways = {}
    for track in recording.tracks:
        _, x, y, orientations, speeds = track.samples.T
        poses = straight.poses(axes.positions(np.stack([x, y], axis=-1)), axes.headings(orientations))
        states = straight.states(poses, speeds)
        ascending = np.maximum.accumulate(states[:, 0]) + 1e-6 * np.arange(len(states))
        ways[track.number] = RecordedWay(ascending, straight.numbers[poses.lane], states)
    return ways


@lru_cache(KEPT)
def traits_of(recording: TrafficRecording) -> dict[int, Float[np.ndarray, "3"]]:
    """Return the logarithms of the traits of all who were recorded, by number, see `shown_traits`.

    They are estimated from the first second of each track, among all that were recorded then.
    """
    tracks, around, traits = recording.tracks, _surroundings(recording), dict[int, np.ndarray]()
    last = max(track.last for track in tracks)
    states = np.full((PAST + last + 1, len(around.sizes), 4), np.nan, np.float32)  # from 2 s before the first step on
    for place, track in enumerate(tracks):
        around.sizes[place] = track.size
        states[PAST - SECOND + track.samples[:, 0].astype(int), place] = ways_of(recording)[track.number].states
    for first in {track.first for track in tracks}:
        past = states[first : first + PAST + 1].copy()
        past[: PAST - SECOND] = np.nan
        shown = np.asarray(_shown(learned_drivers(), around, past))
        traits |= {track.number: shown[place] for place, track in enumerate(tracks) if track.first == first}
    return traits


@cache
def learned_drivers() -> Drivers:
    """Return what was learned of drivers on US-101."""
    drivers = shipped("us101").drivers
    assert drivers is not None  # the package's own file
    return drivers.bare


def _surroundings(recording: TrafficRecording) -> Surroundings:
    """Return surroundings for all tracks and an ego, who have no sizes yet."""
    cars = len(recording.tracks) + 1
    return Surroundings(np.ones((cars + -cars % ROOM, 2)), map_of(recording).straight.lane_width, SPEED_LIMIT)


def _drive(drivers: Drivers, around: Surroundings, traits: Any, wishes: Wishes, states: States) -> States:
    """Return the states of all cars after a step.

    A driver begins to change lanes if there is room, and minds the leaders of both lanes then. What is learned in dense
    traffic does not stop behind a standing car, so drivers also brake as hard as they have to.
    """
    now = seen_states(states)
    _, y, _, speed = now.T
    begun = wishes.side * (y - wishes.lane * around.lane_width) > BEGUN
    side = jnp.where(begun | _has_room(around, wishes, now), wishes.side, 0.0)
    wanted = (wishes.lane + side) * around.lane_width

    def driven(side: Cars) -> tuple[States, Bool[Any, "cars"]]:
        after, leader = moved(drivers, around, traits, side, wanted, now)
        return _slowed(after, _safe_speed(speed, leader)), leader.there

    (after, kept), (led, led_here) = jax.vmap(driven)(jnp.stack([side, jnp.zeros_like(side)]))
    alone = speed + (wishes.usual - speed) * TIME_STEP / SETTLING
    most = jnp.where(led_here, kept[:, 3], jnp.where(led, jnp.inf, alone))
    return _slowed(after, most)


def _has_room(around: Surroundings, wishes: Wishes, states: States) -> Bool[Any, "cars"]:
    """Return whether there is room for each driver in the lane that it wants to change to."""
    x, y, _, speed = states.T
    other, lengths = (wishes.lane + wishes.side) * around.lane_width, around.sizes[:, 0]
    inside = jnp.abs(y - other[:, None]) < around.lane_width / 2 + BEGUN
    ahead = x - x[:, None]
    gap = jnp.abs(ahead) - (lengths + lengths[:, None]) / 2
    closing = jnp.maximum(jnp.sign(ahead) * (speed[:, None] - speed), 0.0)
    blocks = inside & (gap < CLEAR + CLOSING * closing) & ~jnp.eye(len(x), dtype=bool)
    return ~blocks.any(axis=1)


def _safe_speed(speed: Cars, leader: Leader) -> Cars:
    """Return the highest speed after a step with which a driver does not hit its leader, if braking that hard can."""
    hardest = speed - HARDEST * TIME_STEP
    needed = (speed**2 - jnp.maximum(leader.speed, 0.0) ** 2) / (2 * jnp.maximum(leader.gap - STOPPED, 0.1))
    braking = jnp.where(needed > CALM, jnp.maximum(speed - needed * TIME_STEP, hardest), jnp.inf)
    most = jnp.where(leader.gap < STOPPED, jnp.maximum(leader.speed, hardest), braking)
    return jnp.where(leader.there, most, jnp.inf)


def _slowed(after: States, most: Cars) -> States:
    """Return states after a step of cars that are at most so fast after it, never backwards."""
    less = jnp.minimum(jnp.maximum(most, 0.0), after[:, 3]) - after[:, 3]
    return after.at[:, 0].add(less * TIME_STEP / 2).at[:, 3].add(less)


_driven, _shown = jit_quickly(_drive), jit_quickly(shown_traits)
