"""Cut recordings into moments: all cars that are seen at a time, their past, and where they went afterwards."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.irl.arrays import CarFlags, CarNumbers, Cars, CarStates, Flags, Numbers, Paths, Values
from ms_highway.irl.recordings.recording import Recording, number_groups
from ms_highway.irl.windows import padded_lanes
from ms_highway.planning.learned_driving import PAST

STEPS = 50
"""Steps of 0.1 s for which drivers are predicted."""

HORIZONS = (1, 2, 3, 5)
"""Seconds after which predictions are judged."""

AT = 10 * np.array(HORIZONS) - 1
"""Places of the horizons among the steps."""

SCALES = np.array([[0.4, 0.1], [1.0, 0.3], [1.8, 0.5], [3.5, 0.8]])
"""Usual errors at the horizons, along and across the road [m], by which fits weigh them."""

APART = 10  # steps between two moments at which a driver is predicted
SHORTEST = 10  # steps for which a driver must be seen from then on
CARS = 64  # at least, so that one compilation serves most recordings


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moments:
    """n moments of recorded traffic: arrays of NumPy or JAX, in SI units and lane coordinates.

    Attributes:
        past: every car 3 s before, and at each step until now [n, 31, cars, 4]; NaN where it was not seen.
        future: every car after each of the coming steps [n, 50, cars, 4]; NaN where it was not seen.
        sizes: length and width of every car [m].
        lanes: lateral position of each lane's centre [n, lanes], ascending; the last is repeated.
        lane_width: of a lane [m].
        speed_limit: of the road [m/s].
        predicted: which cars are drivers to predict from this moment on.
        track: number of each car's track among all recordings.
        group: number of the recording's group, to split by.
    """

    past: CarStates
    future: CarStates
    sizes: Float[Any, "n cars 2"]
    lanes: Cars
    lane_width: Values
    speed_limit: Values
    predicted: CarFlags
    track: CarNumbers
    group: Numbers

    def __len__(self) -> int:
        return len(self.group)

    @property
    def now(self) -> CarStates:
        """States of all cars, NaN for those that are not seen."""
        return self.past[:, -1]

    @property
    def recorded(self) -> Paths:
        """Positions of the predicted drivers after each step, NaN after they were seen last."""
        return self.tracks(self.future)[..., :2]

    @property
    def which(self) -> Numbers:
        """Number of the moment of each predicted driver."""
        return np.argwhere(self.predicted)[:, 0]

    def of(self, chosen: Flags) -> "Moments":
        """Return the chosen moments."""
        return jax.tree.map(lambda numbers: numbers[chosen], self)

    def drivers(self, values: Any) -> Any:
        """Return the rows of the predicted drivers of values [n, cars, ...], moment after moment."""
        return values[self.predicted]

    def by_fold(self, fold: Numbers, parts: Sequence[Any]) -> Any:
        """Return the rows of the predicted drivers from the part of its moment's fold; parts are tuples of arrays."""
        own = fold[self.which], np.arange(len(self.which))
        return type(parts[0])(*(np.stack(values)[own] for values in zip(*parts, strict=True)))

    def tracks(self, states: CarStates) -> CarStates:
        """Return the states [drivers, times, 4] of the predicted drivers, from those [n, times, cars, 4] of all."""
        return self.drivers(np.moveaxis(states, 1, 2))


def cut_moments(recordings: Sequence[Recording]) -> Moments:
    """Cut the moments at which drivers are predicted: the first of each driver's track and every full second after it.

    Raises:
        ValueError: if no driver was seen for a second.
    """
    groups, rows, tracks_before = number_groups(recordings), [], 0
    cars = max((CARS, *(item.states.shape[1] for item in recordings)))
    for recording, lanes in zip(recordings, padded_lanes(recordings), strict=True):
        track = np.full(cars, -1)
        track[recording.drivers] = tracks_before + np.arange(len(recording.drivers))
        tracks_before += len(recording.drivers)
        missing = cars - recording.states.shape[1]
        states = np.pad(recording.states, ((PAST, STEPS), (0, missing), (0, 0)), constant_values=np.nan)
        sizes = np.pad(recording.sizes, ((0, missing), (0, 0)), constant_values=1.0)
        road = lanes, recording.lane_width, recording.speed_limit
        begins = np.zeros((len(recording.states), cars), dtype=bool)
        for car in recording.drivers:
            seen = np.flatnonzero(recording.seen[:, car])
            begins[seen[0] : max(seen[-1] - SHORTEST + 1, 0) : APART, car] = True
        for time in np.flatnonzero(begins.any(axis=1)):
            past, future = np.split(states[time : time + PAST + 1 + STEPS], [PAST + 1])
            rows.append(Moments(past, future, sizes, *road, begins[time], track, groups[recording.group]))
    if not rows:
        raise ValueError(f"no driver of the {len(recordings)} recordings was seen for {SHORTEST / 10:g} s")
    return jax.tree.map(lambda *parts: np.stack(parts), *rows)


def lanes_of(lanes: Cars, y: Cars) -> CarNumbers:
    """Return the number of the lane whose centre is nearest to each lateral position; the first of repeated ones."""
    xp = y.__array_namespace__()
    return xp.argmin(xp.abs(y[..., None] - lanes[..., None, :]), axis=-1)
