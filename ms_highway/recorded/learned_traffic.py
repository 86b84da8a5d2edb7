"""Drive the vehicles of a recording as learned drivers, who react to the ego and to each other."""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float, Int

from ms_highway.game.learned_drivers import Drivers
from ms_highway.game.learned_reward import shipped_drivers
from ms_highway.game.neighbours import Leader
from ms_highway.game.scenario import TIME_STEP
from ms_highway.planning.learned_driving import (
    PAST,
    SECOND,
    Cars,
    States,
    Surroundings,
    TraitLogarithms,
    moved,
    seen_states,
    shown_traits,
)
from ms_highway.recorded.scenario import KEPT, SPEED_LIMIT, TrafficRecording
from ms_highway.recorded.straight_road import straight_road
from ms_highway.recorded.traffic import CLEAR, GuidedVehicle, RecordedRoad
from ms_highway.runtime.compilation import jit_quickly

ROOM = 16  # cars: arrays grow by so many, so that few numbers of cars compile anew
CLOSING = 1.0  # s, for which a gap in the lane beside has to be long enough at the present speeds
LOOK_AHEAD = 2.0  # s, after which a car will be in the lane that it was recorded in, if it begins to change now
SETTLING = 1.0  # s, in which a car without a leader becomes as fast as it was recorded at its place
STOPPED = 1.0  # m, gap to a standing leader
CALM, HARDEST = 1.5, 8.0  # m/s^2, of braking that is left to the learned reward, and of any braking
BEGUN = 0.3  # m, lateral progress after which a lane change is not given up


class RecordedWay(NamedTuple):
    """A driver of a recording.

    Attributes:
        x: places along the straight road at which it was recorded, ascending [times, m].
        lanes: numbers of the lanes that it was in there [times].
        speeds: there [times, m/s].
        traits: logarithms of those that it shows in its first second, see `shown_traits` [3].
    """

    x: Float[np.ndarray, "times"]
    lanes: Int[np.ndarray, "times"]
    speeds: Float[np.ndarray, "times"]
    traits: Float[np.ndarray, "3"]


class Wishes(NamedTuple):
    """What drivers want besides what was learned of all.

    Attributes:
        lane: number of the lane that each is in.
        side: lanes to the right that it wants to change to, -1, 0 or 1.
        usual: speed without a leader [m/s].
        traits: logarithms, see `shown_traits`.
    """

    lane: Cars
    side: Cars
    usual: Cars
    traits: TraitLogarithms


class LearnedRoad(RecordedRoad):
    """A road on which learned drivers drive, by the traits that each shows in its first second.

    They change lanes where they were recorded to, as soon as there is room. A car that has nobody ahead in sight goes
    as fast as it was recorded at that place: those ahead of it were not recorded. The road computes the steps of all of
    them at once.
    """

    vehicle_type = GuidedVehicle

    def act(self) -> None:
        """Let all vehicles decide what to do in the next step."""
        super().act()
        road, ways, cars = straight_road(self.recording), ways_of(self.recording), self.vehicles
        around = _surroundings(self.recording)
        count = len(around.sizes)
        lane, side, usual = np.zeros((3, count))
        states, wishes = np.full((count, 4), np.nan, np.float32), Wishes(lane, side, usual, np.zeros((count, 3)))
        poses = road.poses_of(cars)
        states[: len(cars)] = road.states(poses, np.array([car.speed for car in cars]))
        wishes.lane[: len(cars)] = road.numbers[poses.lane]
        driven = [place for place, car in enumerate(cars) if not getattr(car, "replayed", True)]
        for place, car in enumerate(cars):
            around.sizes[place] = car.LENGTH, car.WIDTH
            if not getattr(car, "follows_lanes", True):  # such as a pedestrian, who crosses
                states[place, 3] *= max(np.cos(states[place, 2]), 0.0)
        for place in driven:
            (x, _, _, speed), way = states[place], ways[cars[place].track.number]
            later = min(int(np.searchsorted(way.x, x + LOOK_AHEAD * speed)), len(way.x) - 1)
            wishes.side[place] = np.sign(way.lanes[later] - wishes.lane[place])
            wishes.usual[place], wishes.traits[place] = np.interp(x, way.x, way.speeds), way.traits
        after = np.asarray(_driven(shipped_drivers().bare, around, wishes, states), float)
        for place in driven:
            _, _, heading, speed = after[place]
            pose = road.moved(poses, place, after[place, :2] - states[place, :2], heading)
            cars[place].coming = *pose, float(speed)


@lru_cache(KEPT)
def ways_of(recording: TrafficRecording) -> dict[int, RecordedWay]:
    """Return the ways of all tracks of a recording, by number.

    Traits are estimated from the first second of each track, among all that were recorded then.
    """
    road, tracks, around = straight_road(recording), recording.tracks, _surroundings(recording)
    last, found, shown = max(track.last for track in tracks), [road.way(track) for track in tracks], {}
    states = np.full((PAST + last + 1, len(around.sizes), 4), np.nan, np.float32)  # from 2 s before the first step on
    for place, (track, (own, _)) in enumerate(zip(tracks, found, strict=True)):
        around.sizes[place] = track.size
        states[PAST - SECOND + track.samples[:, 0].astype(int), place] = own
    for first in {track.first for track in tracks}:
        past = states[first : first + PAST + 1].copy()
        past[: PAST - SECOND] = np.nan
        shown[first] = np.asarray(_shown(shipped_drivers().bare, around, past))
    ways = {}
    for place, (track, (own, lanes)) in enumerate(zip(tracks, found, strict=True)):
        ascending = np.maximum.accumulate(own[:, 0]) + 1e-6 * np.arange(len(own))
        ways[track.number] = RecordedWay(ascending, lanes, own[:, 3], shown[track.first][place])
    return ways


def _surroundings(recording: TrafficRecording) -> Surroundings:
    """Return surroundings for all tracks and an ego, who have no sizes yet."""
    cars = len(recording.tracks) + 1
    return Surroundings(np.ones((cars + -cars % ROOM, 2)), straight_road(recording).lane_width, SPEED_LIMIT)


def _drive(drivers: Drivers, around: Surroundings, wishes: Wishes, states: States) -> States:
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
        after, leader = moved(drivers, around, wishes.traits, side, wanted, now)
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
