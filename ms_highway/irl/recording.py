"""Recorded driving, simulated or real: the states of all cars in lane coordinates, and
smooth tracks of drivers.

In lane coordinates, x runs along the road, y is the distance to the right of the
leftmost lane's centre, and headings are relative to the road's direction. Recorded
roads are then straight, like those of `ms_highway.game.scene`.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import accumulate, chain
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.game.dynamics import recover_control, step
from ms_highway.game.scenario import PAPER_DYNAMICS, TIME_STEP
from ms_highway.runtime.arrays import Vector
from ms_highway.runtime.sources import digest_of

# Arrays of learning and prediction, of NumPy or JAX
Flags = Bool[Any, "n"]
Numbers = Int[Any, "n"]
Points = Float[Any, "points 2"]
States = Float[Any, "*times 4"]  # x, y, heading and speed
Controls = Float[Any, "*n steps 2"]
Cars = Float[Any, "*n cars"]
CarFlags = Bool[Any, "*n cars"]
CarNumbers = Int[Any, "*n cars"]
CarStates = Float[Any, "*n cars 4"]

MIN_LANES = 6  # to which lanes are padded, so that one compilation serves most roads

# Standard deviations. Errors of position and jerks together decide how smooth tracks
# are: oscillations faster than (JERK dt / POSITION)^(1/3) / dt, here a third of a
# hertz, count as noise. The other three are wide: they only decide what positions do
# not determine, such as the steering of a standing car.
POSITION = 0.2  # m, error of recorded positions
JERK = 2.0  # m/s^3, along the road
LATERAL_JERK = 0.5  # m/s^3, across it
ACCELERATION = 4.0  # m/s^2, along the road
HEADING = 0.2  # rad, at the start
CURVATURE = 0.02  # 1/m

# Cars whose recorded driving says nothing, see `usable`
# m, extent of all positions of a car that only stands: five standard deviations of
# their errors
STANDS = 1.0
# m/s, mean speed below which such a car stands; others were only seen for too few steps
SLOWEST = 0.5
# m, change of velocity in a step of 0.1 s: 400 m/s^2; real recordings have changes of
# up to 1.6 m
JUMP = 4.0
BACKWARDS = -0.5  # m/s
SAME_PLACE = 0.01  # m, between the centres of two cars that are one
SHOWN = 3  # names in a warning

CURVATURE_LIMIT = 0.2  # 1/m, with the front wheels turned by 45 degrees
# in each, speeds are fitted for the last headings, then headings for these speeds; one
# is nearly enough
ROUNDS = 2


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
    states: CarStates
    drivers: Numbers
    sizes: Points
    lanes: Vector
    lane_width: float
    speed_limit: float
    measured: bool = True
    labels: Sequence[str] = ()
    fingerprint: str = ""
    left_out: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that states have three axes, and that every driver was seen without a
        gap, at two times or more.

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
                steps = (
                    f"{len(times)} steps, not at two or more without a gap; leave it"
                    " out of the drivers"
                )
                raise ValueError(f"{self.name}: {self.label(car)} is finite at {steps}")

    def label(self, car: int) -> str:
        """Return the name of a car for messages."""
        return self.labels[car] if self.labels else f"car {car}"

    @cached_property
    def seen(self) -> CarFlags:
        """Whether each car was seen at each time [times, cars]."""
        return np.isfinite(self.states).all(axis=-1)


def fingerprint(numbers: np.ndarray) -> str:
    """Return a short text that is the same only for the same numbers, to a thousandth."""
    rounded = np.round(np.asarray(numbers, dtype=float) * 1000).astype(np.int64)
    return digest_of(rounded.tobytes())


def sources(recordings: Sequence[Recording]) -> dict[str, list[str]]:
    """Return the fingerprints of recordings by their group, as files of learned rewards
    keep them.
    """
    found: dict[str, list[str]] = {}
    for recording in recordings:
        found.setdefault(recording.group, []).append(recording.fingerprint)
    return found


def known_from(
    recordings: Sequence[Recording], learned_from: Mapping[str, Sequence[str]]
) -> list[Recording]:
    """Return those recordings whose drivers may be among those that were learned from,
    given their `sources`.

    A recording may share drivers with one of the same content or, if they were
    measured, of the same group. Simulated episodes have the same groups in all data
    sets.
    """
    contents = set(chain(*learned_from.values())) - {""}
    return [
        each
        for each in recordings
        if each.fingerprint in contents
        or (each.measured and each.group in learned_from)
    ]


def numbered(
    recordings: Sequence[Recording],
) -> Iterator[tuple[Recording, int, int, Vector]]:
    """Number the groups and the drivers of recordings, and pad their lanes to one
    length.

    Yields every recording; the number of its group, in order of appearance; the number
    of its first driver among the drivers of all recordings; and its lanes, of which the
    last is repeated, which changes no feature.
    """
    most = max((MIN_LANES, *(len(item.lanes) for item in recordings)))
    groups: dict[str, int] = {}
    tracks = 0
    for item in recordings:
        lanes = np.pad(
            np.asarray(item.lanes, float), (0, most - len(item.lanes)), mode="edge"
        )
        yield item, groups.setdefault(item.group, len(groups)), tracks, lanes
        tracks += len(item.drivers)


def folds(groups: Numbers, number: int) -> list[Flags]:
    """Return which rows each fold holds out, given their group numbers; every group is
    held out once.
    """
    names = np.unique(groups)
    return [
        np.isin(groups, held_out)
        for held_out in np.array_split(names, min(number, len(names)))
    ]


def usable(recording: Recording) -> Recording:
    """Return the recording without drivers whose driving is impossible or says nothing;
    they are in ``left_out``.

    They remain as neighbours, except that one of two cars that are always in the same
    place disappears.
    """
    states = recording.states.copy()
    reasons = dict(recording.left_out)

    # Two cars that are always in the same place are one car: the second hides the road
    # from the first.
    for first, second in _duplicates(recording):
        states[:, second] = np.nan
        reasons[recording.label(second)] = (
            f"is always where {recording.label(first)} is"
        )

    for car in recording.drivers:
        label = recording.label(car)
        reason = _unusable(
            recording.states[recording.seen[:, car], car], recording.measured
        )
        if reason and label not in reasons:
            reasons[label] = reason
    drivers = [car for car in recording.drivers if recording.label(car) not in reasons]
    return replace(
        recording, states=states, drivers=np.array(drivers, dtype=int), left_out=reasons
    )


def usable_recordings(
    recordings: Sequence[Recording],
) -> tuple[list[Recording], dict[str, str]]:
    """Return the `usable` recordings, and why drivers are left out; warn of these.

    Raises:
        ValueError: if no driver is left.
    """
    kept = [usable(recording) for recording in recordings]
    left_out = {
        f"{label} of {each.name}": why
        for each in kept
        for label, why in each.left_out.items()
    }
    told = listed([f"{label}, which {why}" for label, why in left_out.items()])
    if not any(len(recording.drivers) for recording in kept):
        raise ValueError(
            f"the recordings have no driver{f' but {told}' if told else ''}; give more"
            " recordings"
        )
    if told:
        warnings.warn(
            f"{len(left_out)} {'driver is' if len(left_out) == 1 else 'drivers are'}"
            f" left out: {told}",
            stacklevel=3,
        )
    return kept, left_out


def listed(names: Sequence[str]) -> str:
    """Return the first `SHOWN` names in one text, and the number of the others."""
    more = [f"{len(names) - SHOWN} more"] if len(names) > SHOWN else []
    return "; ".join([*names[:SHOWN], *more])


def _unusable(states: States, measured: bool) -> str:
    """Return why the states of a driver cannot be learned from; empty if they can."""
    positions = states[:, :2]
    seconds = TIME_STEP * (len(states) - 1)
    extent = np.ptp(positions, axis=0).max()
    if extent < STANDS and extent < SLOWEST * seconds:
        return "only stands"
    if not measured:
        return ""
    velocities = np.diff(positions, axis=0)  # m in a step
    changes = np.linalg.norm(np.diff(velocities, axis=0), axis=-1)
    if np.max(changes, initial=0.0) > JUMP:
        return f"jumps at step {2 + changes.argmax()} of its track"
    if states[:, 3].min() < BACKWARDS:
        return f"drives backwards, at {states[:, 3].min():.1f} m/s"
    return ""


def _duplicates(recording: Recording) -> Iterator[tuple[int, int]]:
    """Yield each pair of cars that are in the same place whenever both are seen, if
    twice or more; drivers first.
    """
    positions = np.where(recording.seen[..., None], recording.states[..., :2], np.nan)
    left = [
        *recording.drivers,
        *np.setdiff1d(np.arange(positions.shape[1]), recording.drivers),
    ]
    while left:
        first, *others = left
        times = recording.seen[:, first]
        offsets = positions[times][:, others] - positions[times, first][:, None]
        apart = np.abs(offsets).max(axis=-1)  # [times, others]
        both = np.isfinite(apart)
        farthest = np.max(apart, axis=0, where=both, initial=0.0)
        same = (both.sum(axis=0) > 1) & (farthest < SAME_PLACE)
        for second in np.array(others, dtype=int)[same]:
            yield int(first), int(second)
        left = [car for car, gone in zip(others, same, strict=True) if not gone]


class Rows:
    """Base of pytrees whose arrays have a leading axis [n] of rows."""

    def __len__(self) -> int:
        return len(jax.tree.leaves(self)[0])

    def of(self, chosen: Flags) -> Self:
        """Return the chosen rows."""
        return jax.tree.map(lambda numbers: numbers[chosen], self)


class Track(NamedTuple):
    """States and the controls that lead from each state to the next, by
    `ms_highway.game.dynamics.step`.

    Attributes:
        states: ``(x, y, heading, speed)``, one more than the controls.
        controls: ``(omega, acceleration)``.
    """

    states: States
    controls: Points


def track_of(recording: Recording, car: int) -> Track:
    """Return the track of a car while it was seen: `smoothed` if it was measured, as
    recorded if it was simulated.
    """
    states = recording.states[recording.seen[:, car], car]
    if recording.measured:
        return smoothed(states[:, :2])
    return Track(states, recover_control(PAPER_DYNAMICS, states[:-1], states[1:]))


def smoothed(recorded: Points) -> Track:
    """Return the most likely track of a car, given its recorded positions and priors of accelerations and jerks.

    Recorded speeds and headings are not used: they were derived from noisy positions. With the distance of a step
    ``d = (v + v_next) dt / 2``, two linear least-squares problems are solved in turn: one for the initial x, the
    initial speed v and the accelerations a; one for the initial y, the initial heading h and the curvatures c::

        x = x_0 + sum of d cos(h)    v = v_0 + sum of a dt
        y = y_0 + sum of d sin(h)    h = h_0 + sum of v c dt

    They penalise errors of position, jerks ``a'`` and ``v^2 c'``, and, weakly, a, c and h_0: a standing car therefore
    keeps its heading, and its curvature decays to 0.
    """
    dt = TIME_STEP
    each = np.eye(len(recorded) - 1)
    change = np.diff(each, axis=0)
    cosine = np.ones(len(each))
    sine_per_heading = cosine
    for _ in range(ROUNDS):
        speeds = _cumulative(each * dt)
        distances = (speeds[:-1] + speeds[1:]) * dt / 2
        along = _cumulative(cosine[:, None] * distances)
        x, *motion = _least_squares(
            along, recorded[:, 0], change / (JERK * dt), each / ACCELERATION
        )
        speed = np.maximum(speeds @ motion, 0)

        headings = _cumulative(np.diag(speed[:-1] * dt))
        distance = (speed[:-1] + speed[1:]) * dt / 2
        across = _cumulative((distance * sine_per_heading)[:, None] * headings[:-1])
        jerks = change * speed[1:-1, None] ** 2 / (LATERAL_JERK * dt)
        first = np.eye(1, len(each) + 1) / HEADING
        y, *turning = _least_squares(
            across, recorded[:, 1], jerks, each / CURVATURE, first
        )
        heading = headings @ [
            turning[0],
            *np.clip(turning[1:], -CURVATURE_LIMIT, CURVATURE_LIMIT),
        ]
        cosine = np.cos(heading[:-1])
        sine_per_heading = np.sinc(heading[:-1] / np.pi)

    likeliest = np.stack(np.broadcast_arrays(x, y, heading, speed), axis=-1)
    controls = recover_control(PAPER_DYNAMICS, likeliest[:-1], likeliest[1:])
    states = accumulate(controls, partial(step, PAPER_DYNAMICS), initial=likeliest[0])
    return Track(np.stack(list(states)), controls)


def _cumulative(increments: np.ndarray) -> np.ndarray:
    """Return the matrix from a quantity's initial value and the unknowns of its
    increments to all its values.

    Args:
        increments: matrix from the unknowns to the increments.
    """
    sums = np.pad(np.cumsum(increments, axis=0), ((1, 0), (0, 0)))
    return np.column_stack([np.ones(len(sums)), sums])


def _least_squares(
    positions: np.ndarray, recorded: np.ndarray, *penalties: np.ndarray
) -> np.ndarray:
    """Return the unknowns that fit recorded positions best, with penalties.

    Args:
        positions: matrix from the unknowns to the positions.
        recorded: positions [m].
        penalties: matrices from the last of the unknowns to errors in standard
            deviations.
    """
    likely = np.vstack(
        [
            np.pad(part, ((0, 0), (positions.shape[1] - part.shape[1], 0)))
            for part in penalties
        ]
    )
    errors = np.pad(recorded / POSITION, (0, len(likely)))
    return np.linalg.lstsq(np.vstack([positions / POSITION, likely]), errors)[0]
