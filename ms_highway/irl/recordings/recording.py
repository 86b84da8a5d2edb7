"""Recorded driving, simulated or real: the states of all cars, in lane coordinates.

In lane coordinates, x runs along the road, y to the right of its leftmost lane's centre, and headings are relative to
its direction, so that recorded roads are straight like those of `ms_highway.game.scene`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["Recording", "number_groups"]


@dataclass(frozen=True)
class Recording:
    """All cars on one stretch of road, sampled at equal times; lengths in metres, y points to the right.

    Attributes:
        name: of the source, for messages.
        group: recordings of one group may share drivers, so that no split divides them.
        time_step: between two samples [s].
        states: ``(x, y, heading, speed)`` of every car at every time; NaN where a car was not seen.
        drivers: indices of the cars to learn from and to predict.
        sizes: length and width of every car.
        lanes: lateral position of each lane's centre, ascending.
        lane_width: width of a lane.
        speed_limit: of the road [m/s].
        measured: whether states were measured, with noise; otherwise simulated.
    """

    name: str
    group: str
    time_step: float
    states: Float[np.ndarray, "times cars 4"]
    drivers: Int[np.ndarray, "drivers"]
    sizes: Float[np.ndarray, "cars 2"]
    lanes: Float[np.ndarray, "lanes"]
    lane_width: float
    speed_limit: float
    measured: bool = True

    def __post_init__(self) -> None:
        """Check the recording.

        Raises:
            ValueError: naming the recording and the problem.
        """
        times_and_cars = np.shape(self.states)[:2]
        if np.shape(self.states) != (*times_and_cars, 4) or len(times_and_cars) != 2:
            raise ValueError(f"{self.name}: states have shape {np.shape(self.states)}; they must be [times, cars, 4]")
        if not len(self.lanes):
            raise ValueError(f"{self.name} has no lanes; driving can only be judged on a road")
        if not np.isfinite(self.lanes).all() or not self.lane_width > 0:
            raise ValueError(f"{self.name}: lanes {self.lanes} of width {self.lane_width} are not a road")
        if np.shape(self.sizes) != (times_and_cars[1], 2) or not (np.asarray(self.sizes) > 0).all():
            raise ValueError(
                f"{self.name}: every one of its {times_and_cars[1]} cars needs a positive length and width"
            )
        for car in self.drivers:
            seen = self.seen[:, car]
            first, last = (int(seen.argmax()), len(seen) - int(seen[::-1].argmax())) if seen.any() else (0, 0)
            if last - first < 2:
                raise ValueError(f"{self.name}: car {car} was seen {last - first} times; a track needs two samples")
            if not seen[first:last].all():
                lost = first + int(seen[first:last].argmin())
                raise ValueError(f"{self.name}: car {car} at step {lost} is not finite: {self.states[lost, car]}")

    @cached_property
    def seen(self) -> Bool[np.ndarray, "times cars"]:
        """Whether each car was seen at each time."""
        return np.isfinite(self.states).all(axis=-1)


def number_groups(recordings: Sequence[Recording]) -> dict[str, int]:
    """Number the groups of recordings, by name, in order of appearance."""
    return {name: number for number, name in enumerate(dict.fromkeys(item.group for item in recordings))}
