"""Cut recordings into snapshots: all cars at one time, their past, and where they went
afterwards.

Predictors start from snapshots; `ms_highway.irl.seconds_ahead` learns drivers from
them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.irl.recording import (
    CarFlags,
    CarNumbers,
    Cars,
    CarStates,
    Flags,
    Numbers,
    Recording,
    Rows,
    numbered,
)
from ms_highway.runtime.arrays import Array

PAST_STEPS = 30
"""Steps of 0.1 s before a moment, from which the traits of drivers are inferred."""

STEPS = 50
"""Steps of 0.1 s after a moment, in which drivers drive."""

HORIZONS = (1, 2, 3, 5)
"""Seconds after which predictions are compared with recordings."""

AT = 10 * np.array(HORIZONS) - 1
"""Indices of the horizons among the steps."""

SCALES = np.array([[0.4, 0.1], [1.0, 0.3], [1.8, 0.5], [3.5, 0.8]])
"""Typical errors at the horizons, along and across the road [m], by which fits divide
errors.
"""

APART = 10  # steps between two snapshots in which a driver is predicted
SHORTEST = 10  # steps for which a driver must be seen after a snapshot
MIN_CARS = (
    64  # to which cars are padded, so that one compilation serves most recordings
)

Paths = Float[Any, "n 50 2"]  # x and y after each step of 5 s


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Snapshots(Rows):
    """n snapshots of recorded traffic: arrays of NumPy or JAX, in SI units and lane
    coordinates.

    Attributes:
        past: states of every car at each step from 3 s before until now [n, 31, cars,
            4]; NaN where it was not seen.
        future: states of every car after each of the coming steps [n, 50, cars, 4]; NaN
            where it was not seen.
        sizes: length and width of every car [m].
        lanes: lateral position of each lane's centre [n, lanes], ascending; the last is
            repeated.
        lane_width: of a lane [m].
        speed_limit: of the road [m/s].
        predicted: which cars are drivers to predict.
        track: number of each driver's track among those of all recordings.
        group: number of the recording's group, by which snapshots are split into folds.
    """

    past: CarStates
    future: CarStates
    sizes: Float[Any, "n cars 2"]
    lanes: Cars
    lane_width: Float[Array, "*n"]
    speed_limit: Float[Array, "*n"]
    predicted: CarFlags
    track: CarNumbers
    group: Numbers

    @property
    def now(self) -> CarStates:
        """States of all cars now, NaN where a car is not seen."""
        return self.past[:, -1]

    @property
    def recorded(self) -> Paths:
        """Positions of the predicted drivers after each step, NaN where a driver was
        not seen.
        """
        return self.drivers(np.moveaxis(self.future[..., :2], 1, 2))

    @property
    def which(self) -> Numbers:
        """Number of the snapshot of each predicted driver."""
        return np.nonzero(self.predicted)[0]

    def drivers(self, values: Any) -> Any:
        """Return those of the values [n, cars, ...] that belong to predicted drivers,
        snapshot after snapshot.
        """
        return values[self.predicted]

    def only(self, chosen: Flags) -> Self:
        """Return all snapshots, in which only drivers of the chosen ones are predicted;
        the shapes stay the same.
        """
        return replace(self, predicted=self.predicted & chosen[:, None])


def cut_snapshots(recordings: Sequence[Recording]) -> Snapshots:
    """Cut a snapshot at the start of each driver's track, and one every second after
    it.

    Raises:
        ValueError: if no driver was seen for a second.
    """
    rows = list[Snapshots]()
    cars = max((MIN_CARS, *(item.states.shape[1] for item in recordings)))
    for recording, group, first_track, lanes in numbered(recordings):
        missing = cars - recording.states.shape[1]
        states = np.pad(
            recording.states,
            ((PAST_STEPS, STEPS), (0, missing), (0, 0)),
            constant_values=np.nan,
        )
        sizes = np.pad(recording.sizes, ((0, missing), (0, 0)), constant_values=1.0)
        track = np.full(cars, -1)
        predicted = np.zeros((len(recording.states), cars), dtype=bool)
        track[recording.drivers] = first_track + np.arange(len(recording.drivers))
        for car in recording.drivers:
            seen = np.flatnonzero(recording.seen[:, car])
            predicted[seen[0] : max(seen[-1] - SHORTEST + 1, 0) : APART, car] = True
        for time in np.flatnonzero(predicted.any(axis=1)):
            past, future = np.split(
                states[time : time + PAST_STEPS + 1 + STEPS], [PAST_STEPS + 1]
            )
            rows.append(
                Snapshots(
                    past,
                    future,
                    sizes,
                    lanes,
                    np.asarray(recording.lane_width),
                    np.asarray(recording.speed_limit),
                    predicted[time],
                    track,
                    group,
                )
            )
    if not rows:
        raise ValueError(
            f"no driver of the {len(recordings)} recordings was seen for"
            f" {SHORTEST / 10:g} s"
        )
    return jax.tree.map(lambda *parts: np.stack(parts), *rows)
