"""Cut recordings into moments: all cars that are seen at a time, their past, and where they went afterwards."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.recordings.recording import Recording, number_groups

__all__ = ["PAST", "STEPS", "Moments", "cut_moments", "lanes_of"]

STEPS = 50
"""Steps of 0.1 s for which drivers are predicted."""

PAST = 30
"""Steps of 0.1 s before a moment that predictions may look at."""

APART = 10  # steps between two moments at which a driver is predicted
SHORTEST = 10  # steps for which a driver must be seen from then on
CARS, LANES = 64, 6  # at least, so that one compilation serves most recordings


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Moments:
    """n moments of recorded traffic: arrays of NumPy or JAX, in SI units and lane coordinates.

    Attributes:
        past: every car 3 s before, and at each step until now; NaN where it was not seen.
        future: every car after each of the coming steps; NaN where it was not seen.
        sizes: length and width of every car [m].
        lanes: lateral position of each lane's centre, ascending; the last is repeated.
        lane_width: of a lane [m].
        speed_limit: of the road [m/s].
        predicted: which cars are drivers to predict from this moment on.
        track: number of each car's track among all recordings.
        group: number of the recording's group, to split by.
    """

    past: Float[Any, "n 31 cars 4"]
    future: Float[Any, "n 50 cars 4"]
    sizes: Float[Any, "n cars 2"]
    lanes: Float[Any, "n lanes"]
    lane_width: Float[Any, "n"]
    speed_limit: Float[Any, "n"]
    predicted: Bool[Any, "n cars"]
    track: Int[Any, "n cars"]
    group: Int[Any, "n"]

    def __len__(self) -> int:
        return len(self.group)

    @property
    def now(self) -> Float[Any, "n cars 4"]:
        """States of all cars, NaN for those that are not seen."""
        return self.past[:, -1]

    @property
    def recorded(self) -> Float[np.ndarray, "drivers 50 2"]:
        """Positions of the predicted drivers after each step, NaN after they were seen last."""
        return self.drivers(np.moveaxis(np.asarray(self.future), 1, 2))[..., :2]

    def of(self, chosen: Bool[np.ndarray, "n"]) -> "Moments":
        """Return the chosen moments."""
        return jax.tree.map(lambda numbers: numbers[chosen], self)

    def drivers(self, values: Any) -> Any:
        """Return the rows of the predicted drivers of values [n, cars, ...], moment after moment."""
        return values[self.predicted]


def cut_moments(recordings: Sequence[Recording]) -> Moments:
    """Cut the moments at which drivers are predicted: the first of each driver's track and every full second after it.

    Args:
        recordings: the recordings to cut.

    Raises:
        ValueError: if no driver was seen for a second, or a recording's time step is not 0.1 s.
    """
    groups = number_groups(recordings)
    cars = max((CARS, *(item.states.shape[1] for item in recordings)))
    lanes = max((LANES, *(len(item.lanes) for item in recordings)))
    rows, first_track = [], 0
    for recording in recordings:
        if not np.isclose(recording.time_step, TIME_STEP):
            step = recording.time_step
            raise ValueError(f"{recording.name} has a time step of {step} s, not of {TIME_STEP} s; resample it")
        tracks = np.full(cars, -1)
        tracks[recording.drivers] = first_track + np.arange(len(recording.drivers))
        first_track += len(recording.drivers)
        missing = cars - recording.states.shape[1]
        states = np.pad(recording.states, ((PAST, STEPS), (0, missing), (0, 0)), constant_values=np.nan)
        road = np.pad(np.asarray(recording.lanes, dtype=float), (0, lanes - len(recording.lanes)), mode="edge")
        begins = {int(car): _begins(recording, int(car)) for car in recording.drivers}
        for time in sorted({time for times in begins.values() for time in times}):
            predicted = np.zeros(cars, dtype=bool)
            predicted[[car for car, times in begins.items() if time in times]] = True
            rows.append(
                Moments(
                    past=states[time : time + PAST + 1],
                    future=states[time + PAST + 1 : time + PAST + 1 + STEPS],
                    sizes=np.pad(recording.sizes, ((0, missing), (0, 0)), constant_values=1.0),
                    lanes=road,
                    lane_width=np.float64(recording.lane_width),
                    speed_limit=np.float64(recording.speed_limit),
                    predicted=predicted,
                    track=tracks,
                    group=np.int64(groups[recording.group]),
                )
            )
    if not rows:
        raise ValueError(f"no driver of the {len(recordings)} recordings was seen for {SHORTEST / 10:g} s")
    return jax.tree.map(lambda *parts: np.stack(parts), *rows)


def lanes_of(lanes: Float[Any, "*n lanes"], y: Float[Any, "*n cars"]) -> Int[Any, "*n cars"]:
    """Return the number of the lane whose centre is nearest to each lateral position."""
    xp = y.__array_namespace__()
    return xp.argmin(xp.abs(y[..., None] - lanes[..., None, :]), axis=-1)


def _begins(recording: Recording, car: int) -> range:
    """Return the times at which a car is predicted."""
    seen = np.flatnonzero(recording.seen[:, car])
    return range(seen[0], seen[-1] - SHORTEST + 1, APART)
