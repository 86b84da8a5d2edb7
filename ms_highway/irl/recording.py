"""Hold recorded driving, simulated or real: the states of all cars in lane coordinates.

In lane coordinates, x runs along the road, y is the distance to the right of the
leftmost lane's centre, and headings are relative to the road's direction. Recorded
roads are then straight, like those of `ms_highway.game.scene`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.runtime.arrays import Array
from ms_highway.runtime.sources import digest_of

# Arrays of learning and prediction, of NumPy or JAX
Flags = Bool[Array, "n"]
Numbers = Int[Array, "n"]
States = Float[Array, "*times 4"]  # x, y, heading and speed
Controls = Float[Array, "*n steps 2"]
Cars = Float[Array, "*n cars"]
CarFlags = Bool[Array, "*n cars"]
CarNumbers = Int[Array, "*n cars"]
CarStates = Float[Array, "*n cars 4"]


@dataclass(frozen=True)
class Recording:
    """All cars on one stretch of road, sampled every 0.1 s, in lane coordinates.

    Attributes:
        name: of the source, for messages.
        group: name of the recordings that may share drivers; a split into folds keeps
            them together.
        states: ``(x, y, heading, speed)`` of every car at every time [times, cars, 4];
            NaN where a car was not seen.
        drivers: indices of the cars to learn from and to predict.
        sizes: length and width of every car [cars, 2, m].
        lanes: lateral position of each lane's centre, ascending [m].
        lane_width: width of a lane [m].
        speed_limit: of the road [m/s].
        measured: whether states were measured, with noise; otherwise they were
            simulated.
        labels: name of each car in the source, for messages; by default, cars are
            numbered.
        fingerprint: of the source's content, by which it is known again under another
            name; empty if it is not known.
        left_out: reasons why cars are no drivers although they drive, by their labels.
    """

    name: str
    group: str
    states: Float[np.ndarray, "times cars 4"]
    drivers: Int[np.ndarray, "drivers"]
    sizes: Float[np.ndarray, "cars 2"]
    lanes: Float[np.ndarray, "lanes"]
    lane_width: float
    speed_limit: float
    measured: bool = True
    labels: Sequence[str] = ()
    fingerprint: str = ""
    left_out: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the shape of states, and that every driver was seen without a gap.

        Raises:
            ValueError: naming the recording, and the shape or the car.
        """
        if np.ndim(self.states) != 3 or np.shape(self.states)[2] != 4:
            raise ValueError(
                f"{self.name}: states have shape {np.shape(self.states)}; they must be"
                " [times, cars, 4]"
            )
        for car in self.drivers:
            times = np.flatnonzero(self.seen[:, car])
            if len(times) < 2 or np.ptp(times) >= len(times):
                raise ValueError(
                    f"{self.name}: {self.label(car)} is finite at {len(times)} steps,"
                    " not at two or more without a gap; leave it out of the drivers"
                )

    def label(self, car: int) -> str:
        """Return the name of a car for messages."""
        return self.labels[car] if self.labels else f"car {car}"

    @cached_property
    def seen(self) -> Bool[np.ndarray, "times cars"]:
        """Whether each car was seen at each time."""
        return np.all(np.isfinite(self.states), axis=-1)


def fingerprint(numbers: np.ndarray) -> str:
    """Return a short text that is the same only for the same numbers.

    Numbers are compared to a thousandth.
    """
    rounded = np.round(np.asarray(numbers, dtype=float) * 1000).astype(np.int64)
    return digest_of(rounded.tobytes())


def sources(recordings: Sequence[Recording]) -> dict[str, list[str]]:
    """Return the fingerprints of recordings by group, as learned rewards keep them."""
    fingerprints: dict[str, list[str]] = {}
    for recording in recordings:
        fingerprints.setdefault(recording.group, []).append(recording.fingerprint)
    return fingerprints


def known_from(
    recordings: Sequence[Recording],
    learned_from: Mapping[str, Sequence[str]],
) -> list[Recording]:
    """Return the recordings that may share drivers with those learned from.

    Those are given by their `sources`. A recording may share drivers with one of the
    same content or, if they were measured, of the same group. Simulated episodes have
    the same groups in all data sets.
    """
    contents = set(chain(*learned_from.values())) - {""}
    return [
        recording
        for recording in recordings
        if recording.fingerprint in contents
        or (recording.measured and recording.group in learned_from)
    ]


class NumberedRecording(NamedTuple):
    """A recording among others, numbered.

    Attributes:
        recording: as it is.
        group: number of its group, in order of appearance.
        first_track: number of its first driver among the drivers of all recordings.
        lanes: its lanes, padded to the same number as those of the others; the last is
            repeated, which changes no feature [m].
    """

    recording: Recording
    group: int
    first_track: int
    lanes: Float[np.ndarray, "lanes"]


def numbered(recordings: Sequence[Recording]) -> Iterator[NumberedRecording]:
    """Number the groups and the drivers of recordings, and pad their lanes."""
    least = 6  # lanes, so that one compilation serves most roads
    most = max((least, *(len(recording.lanes) for recording in recordings)))
    groups: dict[str, int] = {}
    tracks = 0
    for recording in recordings:
        missing = most - len(recording.lanes)
        lanes = np.pad(np.asarray(recording.lanes, float), (0, missing), mode="edge")
        group = groups.setdefault(recording.group, len(groups))
        yield NumberedRecording(recording, group, tracks, lanes)
        tracks += len(recording.drivers)


def folds(groups: Numbers, number: int) -> list[Flags]:
    """Return which rows each fold holds out, given their group numbers.

    Every group is held out once.
    """
    names = np.unique(groups)
    parts = np.array_split(names, min(number, len(names)))
    return [np.isin(groups, held_out) for held_out in parts]


class Rows:
    """Base of pytrees whose arrays have a leading axis [n] of rows."""

    def __len__(self) -> int:
        return len(jax.tree.leaves(self)[0])

    def of(self, chosen: Flags) -> Self:
        """Return the chosen rows."""
        return jax.tree.map(lambda numbers: numbers[chosen], self)
