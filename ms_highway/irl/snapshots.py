"""Cut recordings into snapshots: all cars at one time, their past and their future.

Predictors start from snapshots; `ms_highway.irl.seconds_ahead` learns drivers from
them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.irl.recording import (
    CarFlags,
    CarNumbers,
    Cars,
    CarStates,
    Flags,
    NumberedRecording,
    Numbers,
    Recording,
    Rows,
    numbered,
)
from ms_highway.runtime.arrays import Array, SameArray

Paths = Float[Array, "n 50 2"]  # x and y after each step of 5 s


@dataclass(frozen=True)
class SnapshotSettings:
    """Set what a snapshot holds, and how many are cut."""

    steps_per_second: int = 10
    """Steps of a second."""
    past_steps: int = 30
    """Steps before a snapshot, from which the traits of drivers are inferred."""
    future_steps: int = 50
    """Steps after a snapshot, in which drivers drive."""
    min_future_steps: int = 10
    """Steps for which a driver must be seen after a snapshot."""
    steps_between: int = 10
    """Steps between two snapshots in which a driver is predicted."""
    min_cars: int = 64
    """Number to which cars are padded: one compilation serves most recordings."""


SNAPSHOT = SnapshotSettings()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Snapshots(Rows):
    """n snapshots of recorded traffic, in SI units and lane coordinates.

    The arrays are NumPy's or JAX's.

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
    sizes: Float[Array, "n cars 2"]
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
        """Positions of the predicted drivers after each step, NaN where not seen."""
        return self.drivers(np.moveaxis(np.asarray(self.future)[..., :2], 1, 2))

    @property
    def which(self) -> Numbers:
        """Number of the snapshot of each predicted driver."""
        return np.nonzero(self.predicted)[0]

    def drivers(self, values: SameArray) -> SameArray:
        """Return those of the values [n, cars, ...] that belong to predicted drivers.

        They come snapshot after snapshot.
        """
        return values[self.predicted]

    def only(self, chosen: Flags) -> Self:
        """Return all snapshots, in which only drivers of the chosen ones are predicted.

        The shapes stay the same.
        """
        return replace(self, predicted=self.predicted & chosen[:, None])


def cut_snapshots(recordings: Sequence[Recording]) -> Snapshots:
    """Cut a snapshot at the start of each driver's track, and every second later.

    Raises:
        ValueError: if no driver was seen for a second.
    """
    numbers = [recording.states.shape[1] for recording in recordings]
    cars = max([SNAPSHOT.min_cars, *numbers])
    snapshots = [
        snapshot for each in numbered(recordings) for snapshot in _cut(each, cars)
    ]
    if not snapshots:
        raise ValueError(
            f"no driver of the {len(recordings)} recordings was seen for"
            f" {SNAPSHOT.min_future_steps / SNAPSHOT.steps_per_second:g} s"
        )
    return jax.tree.map(lambda *parts: np.stack(parts), *snapshots)


def _cut(numbered_recording: NumberedRecording, cars: int) -> list[Snapshots]:
    """Return the snapshots of one recording, each without the axis of snapshots.

    Args:
        numbered_recording: the recording with its numbers.
        cars: number to which its cars are padded.
    """
    recording, group, first_track, lanes = numbered_recording
    past_steps = SNAPSHOT.past_steps
    future_steps = SNAPSHOT.future_steps

    # Pad cars, and times before and after the recording.
    missing = cars - recording.states.shape[1]
    states = np.pad(
        recording.states,
        ((past_steps, future_steps), (0, missing), (0, 0)),
        constant_values=np.nan,
    )
    sizes = np.pad(recording.sizes, ((0, missing), (0, 0)), constant_values=1.0)

    # Which cars are predicted at each time.
    track = np.full(cars, -1)
    track[recording.drivers] = first_track + np.arange(len(recording.drivers))
    predicted = np.zeros((len(recording.states), cars), dtype=bool)
    for car in recording.drivers:
        seen = np.flatnonzero(recording.seen[:, car])
        end = max(seen[-1] - SNAPSHOT.min_future_steps + 1, 0)
        predicted[seen[0] : end : SNAPSHOT.steps_between, car] = True

    snapshots = []
    for time in np.flatnonzero(predicted.any(axis=1)):
        around = states[time : time + past_steps + 1 + future_steps]
        past, future = np.split(around, [past_steps + 1])
        snapshot = Snapshots(
            past=past,
            future=future,
            sizes=sizes,
            lanes=lanes,
            lane_width=np.asarray(recording.lane_width),
            speed_limit=np.asarray(recording.speed_limit),
            predicted=predicted[time],
            track=track,
            group=np.asarray(group),
        )
        snapshots.append(snapshot)
    return snapshots
