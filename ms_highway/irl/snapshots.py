"""Cut recordings into snapshots: all cars that are seen at a time, their past, and where they went afterwards.

Predictors start from snapshots, and drivers are learned from them, see `ms_highway.irl.seconds_ahead`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.irl.recording import CarFlags, CarNumbers, Cars, CarStates, Flags, Numbers, Recording, Rows, numbered
from ms_highway.planning.learned_driving import PAST_STEPS
from ms_highway.runtime.arrays import Vector

STEPS = 50
"""Steps of 0.1 s for which drivers are predicted."""

HORIZONS = (1, 2, 3, 5)
"""Seconds after which predictions are measured."""

AT = 10 * np.array(HORIZONS) - 1
"""Places of the horizons among the steps."""

SCALES = np.array([[0.4, 0.1], [1.0, 0.3], [1.8, 0.5], [3.5, 0.8]])
"""Typical errors at the horizons, along and across the road [m], by which fits weigh them."""

APART = 10  # steps between two snapshots in which a driver is predicted
SHORTEST = 10  # steps for which a driver must be seen from then on
CARS = 64  # at least, so that one compilation serves most recordings

Paths = Float[Any, "n 50 2"]  # x and y after each step of 5 s


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Snapshots(Rows):
    """n snapshots of recorded traffic: arrays of NumPy or JAX, in SI units and lane coordinates.

    Attributes:
        past: every car 3 s before, and at each step until now [n, 31, cars, 4]; NaN where it was not seen.
        future: every car after each of the coming steps [n, 50, cars, 4]; NaN where it was not seen.
        sizes: length and width of every car [m].
        lanes: lateral position of each lane's centre [n, lanes], ascending; the last is repeated.
        lane_width: of a lane [m].
        speed_limit: of the road [m/s].
        predicted: which cars are drivers to predict.
        track: number of each car's track among all recordings.
        group: number of the recording's group, to split by.
    """

    past: CarStates
    future: CarStates
    sizes: Float[Any, "n cars 2"]
    lanes: Cars
    lane_width: Vector
    speed_limit: Vector
    predicted: CarFlags
    track: CarNumbers
    group: Numbers

    @property
    def now(self) -> CarStates:
        """States of all cars, NaN for those that are not seen."""
        return self.past[:, -1]

    @property
    def recorded(self) -> Paths:
        """Positions of the predicted drivers after each step, NaN after they were seen last."""
        return self.drivers(np.moveaxis(self.future[..., :2], 1, 2))

    @property
    def which(self) -> Numbers:
        """Number of the snapshot of each predicted driver."""
        return np.nonzero(self.predicted)[0]

    def drivers(self, values: Any) -> Any:
        """Return the rows of the predicted drivers of values [n, cars, ...], snapshot after snapshot."""
        return values[self.predicted]

    def only(self, chosen: Flags) -> Self:
        """Return as many snapshots, for one compilation, in which just the drivers of the chosen ones are predicted."""
        return replace(self, predicted=self.predicted & chosen[:, None])


def cut_snapshots(recordings: Sequence[Recording]) -> Snapshots:
    """Cut the snapshots in which drivers are predicted: the first of each driver's track and every full second after.

    Raises:
        ValueError: if no driver was seen for a second.
    """
    rows = list[Snapshots]()
    cars = max((CARS, *(item.states.shape[1] for item in recordings)))
    for recording, group, first_track, lanes in numbered(recordings):
        track, predicted = np.full(cars, -1), np.zeros((len(recording.states), cars), dtype=bool)
        track[recording.drivers] = first_track + np.arange(len(recording.drivers))
        for car in recording.drivers:
            seen = np.flatnonzero(recording.seen[:, car])
            predicted[seen[0] : max(seen[-1] - SHORTEST + 1, 0) : APART, car] = True
        rows += snapshots_at(recording, predicted, lanes, track, group)
    if not rows:
        raise ValueError(f"no driver of the {len(recordings)} recordings was seen for {SHORTEST / 10:g} s")
    return jax.tree.map(lambda *parts: np.stack(parts), *rows)


def snapshots_at(
    recording: Recording, predicted: CarFlags, lanes: Vector, track: CarNumbers, group: int
) -> Iterator[Snapshots]:
    """Yield the snapshots of a recording in which some cars are to be predicted [times, cars, unseen ones included]."""
    missing = predicted.shape[1] - recording.states.shape[1]
    states = np.pad(recording.states, ((PAST_STEPS, STEPS), (0, missing), (0, 0)), constant_values=np.nan)
    sizes = np.pad(recording.sizes, ((0, missing), (0, 0)), constant_values=1.0)
    road = lanes, recording.lane_width, recording.speed_limit
    for time in np.flatnonzero(predicted.any(axis=1)):
        past, future = np.split(states[time : time + PAST_STEPS + 1 + STEPS], [PAST_STEPS + 1])
        yield Snapshots(past, future, sizes, *road, predicted[time], track, group)


def lane_numbers(lanes: Cars, y: Cars) -> CarNumbers:
    """Return the number of the lane whose centre is nearest to each lateral position; the first of repeated ones."""
    xp = y.__array_namespace__()
    return xp.argmin(xp.abs(y[..., None] - lanes[..., None, :]), axis=-1)
