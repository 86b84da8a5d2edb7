"""Leave out drivers whose recorded driving is impossible or says nothing."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ms_highway.game.scenario import TIME_STEP
from ms_highway.irl.recording import Recording, States


@dataclass(frozen=True)
class UsableDriving:
    """Set which recorded driving can be learned from."""

    standing_extent: float = 1.0
    """Extent of all positions of a car that only stands [m]: five standard deviations
    of their errors.
    """
    standing_speed: float = 0.5
    """Mean speed below which such a car stands [m/s]; others were only seen for too few
    steps.
    """
    jump: float = 4.0
    """Change of the distance per step from one step to the next that is impossible [m]:
    400 m/s^2. Real recordings have changes of up to 1.6 m.
    """
    backwards: float = -0.5
    """Speed below which a car drives backwards [m/s]."""
    same_place: float = 0.01
    """Distance between the centres of two cars that are one [m]."""


USABLE = UsableDriving()


def usable(recording: Recording) -> Recording:
    """Return the recording without drivers that say nothing.

    Their driving is impossible, or they only stand; ``left_out`` says why. They remain
    as neighbours, except that one of two cars that are always in the same place
    disappears.
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
        driven = recording.states[recording.seen[:, car], car]
        reason = _why_unusable(driven, recording.measured)
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
    with_usable = [usable(recording) for recording in recordings]
    left_out = {}
    for recording in with_usable:
        for label, reason in recording.left_out.items():
            left_out[f"{label} of {recording.name}"] = reason
    reasons = listed([f"{label}, which {why}" for label, why in left_out.items()])
    if not any(len(recording.drivers) for recording in with_usable):
        but = f" but {reasons}" if reasons else ""
        raise ValueError(f"the recordings have no driver{but}; give more recordings")
    if left_out:
        number = len(left_out)
        subject = "1 driver is" if number == 1 else f"{number} drivers are"
        warnings.warn(f"{subject} left out: {reasons}", stacklevel=3)
    return with_usable, left_out


def listed(names: Sequence[str], shown: int = 3) -> str:
    """Return the first names in one text, and the number of the others."""
    others = [f"{len(names) - shown} more"] if len(names) > shown else []
    return "; ".join([*names[:shown], *others])


def _why_unusable(states: States, measured: bool) -> str:
    """Return why the states of a driver cannot be learned from; empty if they can."""
    # Standing cars show nothing of what a driver wants.
    positions = states[:, :2]
    seconds = TIME_STEP * (len(states) - 1)
    extent = np.ptp(positions, axis=0).max()
    slow_extent = USABLE.standing_speed * seconds
    if extent < USABLE.standing_extent and extent < slow_extent:
        return "only stands"
    if not measured:
        return ""

    # Errors of measurements.
    distances = np.diff(positions, axis=0)  # in each step
    changes = np.linalg.norm(np.diff(distances, axis=0), axis=-1)
    if np.max(changes, initial=0.0) > USABLE.jump:
        return f"jumps at step {2 + changes.argmax()} of its track"
    slowest = states[:, 3].min()
    if slowest < USABLE.backwards:
        return f"drives backwards, at {slowest:.1f} m/s"
    return ""


def _duplicates(recording: Recording) -> Iterator[tuple[int, int]]:
    """Yield each pair of cars that are always in the same place; drivers first.

    Always is whenever both are seen, if twice or more.
    """
    seen = recording.seen
    positions = np.where(seen[..., None], recording.states[..., :2], np.nan)
    cars = np.arange(positions.shape[1])
    remaining = [*recording.drivers, *np.setdiff1d(cars, recording.drivers)]
    while remaining:
        first, *others = remaining

        # The largest distance in x or y whenever both are seen.
        times = seen[:, first]
        own_positions = positions[times, first]
        offsets = positions[times][:, others] - own_positions[:, None]
        distances = np.abs(offsets).max(axis=-1)  # [times, others]
        both_seen = np.isfinite(distances)
        farthest = np.max(distances, axis=0, where=both_seen, initial=0.0)

        is_near = farthest < USABLE.same_place
        is_same = (both_seen.sum(axis=0) > 1) & is_near
        other_cars = np.array(others, dtype=int)
        for second in other_cars[is_same]:
            yield int(first), int(second)
        remaining = other_cars[~is_same].tolist()
