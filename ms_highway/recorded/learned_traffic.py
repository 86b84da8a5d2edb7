"""Move the others in recorded traffic as learned drivers, who react to the ego and to each other."""

from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np

from ms_highway.game.learned_reward import shipped
from ms_highway.game.scenario import TIME_STEP
from ms_highway.planning.learned_driving import PAST, SECOND, moved, seen_states, shown_traits
from ms_highway.recorded.scenario import SPEED_LIMIT
from ms_highway.recorded.straight_road import States
from ms_highway.recorded.traffic import CLEAR, Traffic
from ms_highway.runtime.compilation import jit_quickly

ROOM = 16  # cars: arrays grow by so many, so that few numbers of cars compile anew
CLOSING = 1.0  # s, for which a faster car behind has to fit into the gap besides
LOOK_AHEAD = 2.0  # s, after which a car will be in the lane that it was recorded in, if it begins to change now
FORCED = 40.0  # m before the end of a lane, from which who has to leave it cares for no one behind
SETTLING = 1.0  # s, in which who has nobody ahead goes as fast as it was recorded there
STOPPED = 1.0  # m, gap that is kept to who stands ahead
CALM, HARDEST = 1.5, 8.0  # m/s^2, of braking that is left to what was learned, and of any
BEGUN = 0.3  # m towards a lane, from which a change to it is not given up


class Learned(Traffic):
    """Learned drivers, who react to the ego and to each other, by the traits that each shows in its first second.

    They change lanes where they were recorded to, as soon as there is room. Who has nobody ahead in sight goes as fast
    as it was recorded at that place: those ahead of it were not recorded.
    """

    def __init__(self, *given: Any) -> None:
        """Prepare traffic, see `Traffic`."""
        super().__init__(*given)
        drivers = shipped("us101").drivers
        assert drivers is not None  # the package's own file
        self.drivers = drivers.bare
        self.count = len(self.tracks) + 1
        self.count += -self.count % ROOM
        sizes = np.ones((self.count, 2))
        sizes[: len(self.everyone)] = [track.size for track in self.everyone]
        self.surroundings = _Lanes(sizes, self.straight.lane_width, SPEED_LIMIT)
        self.paths = [self.straight.path(track) for track in self.everyone]
        self.ways = [np.maximum.accumulate(path[:, 0]) + 1e-6 * np.arange(len(path)) for path in self.paths]

    @cached_property
    def traits(self) -> np.ndarray:
        """What each driver is like, by its first second among all who were recorded then [cars, 3].

        Not before the first step: no environment computes before that.
        """
        traits, last = np.zeros((self.count, 3), np.float32), max(track.last for track in self.everyone)
        states = np.full((last + SECOND + 1, self.count, 4), np.nan, np.float32)
        for place, (track, path) in enumerate(zip(self.everyone, self.paths, strict=True)):
            states[track.samples[:, 0].astype(int), place] = path
        for first in {track.first for track in self.tracks}:
            past = np.full((PAST + 1, self.count, 4), np.nan, np.float32)
            past[PAST - SECOND :] = states[first : first + SECOND + 1]
            shown = np.asarray(_shown(self.drivers, self.surroundings, past))
            begun = [place for place, track in enumerate(self.tracks) if track.first == first]
            traits[begun] = shown[begun]
        return traits

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
            x, _, _, speed = states[place]
            usual = np.interp(x, self.ways[place], self.paths[place][:, 3])
            most[place] = speed + (usual - speed) * TIME_STEP / SETTLING
        _slow_down(after, most)
        drivers = [place for place in self.vehicles if self.tracks[place].drives]
        poses = zip(*self.straight.bend(after[drivers].astype(float)), strict=True)
        for place, pose in zip(drivers, poses, strict=True):
            self.vehicles[place].put(*pose, after[place, 3])
        self._move_on(lambda place: after[place, 0] > self.end)

    def _states(self) -> States:
        """Return the states on the straight road of all cars, the ego's after them; NaN where there is none."""
        states = np.full((self.count, 4), np.nan, np.float32)
        cars = self.vehicles | dict(enumerate(self.egos, len(self.tracks)))
        states[[*cars]] = self.straight.states(cars.values())
        replayed = [place for place in self.vehicles if not self.tracks[place].drives]
        states[replayed, 3] *= np.maximum(np.cos(states[replayed, 2]), 0.0)  # who crosses does not drive ahead
        self.surroundings.sizes[[*cars]] = [(vehicle.LENGTH, vehicle.WIDTH) for vehicle in cars.values()]
        return states

    def _wishes(self, states: States) -> tuple[np.ndarray, np.ndarray]:
        """Return how many lanes to the right each changes now, and the middle of the lane that it wants."""
        width, lanes = self.straight.lane_width, self._lanes(states[:, 1])
        side = np.zeros(self.count, dtype=np.int32)
        for place in self.vehicles:
            path, (x, y, _, speed), lane = self.paths[place], states[place], lanes[place]
            later = min(int(np.searchsorted(self.ways[place], x + LOOK_AHEAD * speed)), len(path) - 1)
            wish = int(np.sign(self._lanes(path[later, 1]) - lane))
            begun = wish * (y - lane * width) > BEGUN
            if wish and self.tracks[place].drives and (begun or self._has_room(states, place, lane, lane + wish)):
                side[place] = wish
        return side, ((lanes + side) * width).astype(np.float32)

    def _lanes(self, y: np.ndarray) -> np.ndarray:
        """Return the number of the lane at lateral positions, any where nobody is."""
        return np.rint(np.nan_to_num(y) / self.straight.lane_width).clip(0, len(self.straight.there) - 1).astype(int)

    def _has_room(self, states: States, place: int, lane: int, other: int) -> bool:
        """Return whether there is room for a driver in another lane."""
        x, _, _, speed = states[place]
        inside = np.abs(states[:, 1] - other * self.straight.lane_width) < self.straight.lane_width / 2 + BEGUN
        inside[place] = False
        ahead, lengths = states[:, 0] - x, (self.surroundings.sizes[:, 0] + self.surroundings.sizes[place, 0]) / 2
        closing = np.where(ahead > 0, speed - states[:, 3], states[:, 3] - speed)
        needed = CLEAR + CLOSING * np.maximum(closing, 0.0) * (not self.straight.lane_ends(lane, x, FORCED))
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
