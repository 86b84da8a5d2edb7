"""Convert CommonRoad scenarios to recordings in lane coordinates."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ms_highway.geometry.curve import Curve
from ms_highway.irl.recording import Recording, fingerprint
from ms_highway.recorded.commonroad import read_scenario, scenario_files
from ms_highway.recorded.network import Axes, smooth_curves
from ms_highway.recorded.scenario import (
    Points,
    RecordedTrack,
    TrafficRecording,
)
from ms_highway.recorded.straight_road import straight_road

TrackIdentity = tuple[str, int, float, float]
"""Group of the recording, number of the track, and where it begins in the map."""


def read_directory(directory: Path, first: int | None = None) -> list[Recording]:
    """Read the CommonRoad scenarios of a directory, in the order of their names.

    Files are ``*.xml`` and ``*.xml.gz``. Every vehicle that drives in lanes is a
    driver, unless it was seen only once or with a gap, or drives against the road; all
    other road users are only neighbours. Files cut from one recording, such as
    ``USA_US101-10_4_T-1`` and ``USA_US101-10_5_T-1``, form a group and may share
    tracks: a track is a driver in the first file that has it, and only a neighbour in
    the others.

    Args:
        directory: of the files.
        first: number of files to read; None for all.

    Raises:
        ValueError: if there is no file, or a file is not a scenario with lanes, drivers
            and the time step 0.1 s.
    """
    counted = set[TrackIdentity]()
    recordings = []
    for path in scenario_files(directory)[:first]:
        scenario = read_scenario(path)
        try:
            recordings.append(_convert(scenario, counted))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    return recordings


def _convert(scenario: TrafficRecording, counted: set[TrackIdentity]) -> Recording:
    """Convert a scenario to a recording.

    Its drivers are added to those that earlier files have counted.
    """
    road = straight_road(scenario)
    parallel = _parallel_lanes(road.lines)
    tracks = scenario.tracks
    states = _lane_states(tracks, road.axes, parallel.curve)

    # A track is a driver in the first file that has it.
    labels = [f"obstacle {track.number}" for track in tracks]
    drivers = []
    left_out = {}
    for car, track in enumerate(tracks):
        steps = track.samples[:, 0].astype(int)
        headings = states[steps, car, 2]
        with_the_road = np.abs(np.median(headings)) < np.pi / 2
        is_driver = track.drives and len(steps) > 1 and with_the_road
        identity = _identity(scenario.group, track)
        if not is_driver or identity in counted:
            continue
        counted.add(identity)
        has_gap = np.ptp(steps) >= len(steps)
        if has_gap:
            left_out[labels[car]] = (
                f"was not seen at each step from {steps[0]} to {steps[-1]}"
            )
        else:
            drivers.append(car)

    lanes = parallel.lanes
    width = float(np.median(np.diff(lanes))) if len(lanes) > 1 else road.lane_width
    samples = np.concatenate([track.samples for track in tracks])
    return Recording(
        name=scenario.name,
        group=scenario.group,
        states=states,
        drivers=np.array(drivers, dtype=int),
        sizes=np.array([track.size for track in tracks]),
        lanes=lanes,
        lane_width=width,
        speed_limit=TrafficRecording.default_speed_limit,
        labels=labels,
        fingerprint=fingerprint(samples),
        left_out=left_out,
    )


def _identity(group: str, track: RecordedTrack) -> TrackIdentity:
    """Return what a track has in common with the same track in another file."""
    x, y = track.samples[0, 1:3].round(2).tolist()
    return group, track.number, x, y


def _lane_states(
    tracks: Sequence[RecordedTrack],
    axes: Axes,
    curve: Curve,
) -> Float[np.ndarray, "times cars 4"]:
    """Return the states of all tracks along and across a lane, NaN where not seen."""
    times = 1 + max(track.last for track in tracks)
    states = np.full((times, len(tracks), 4), np.nan)
    for car, track in enumerate(tracks):
        steps, _, _, orientation, speed = track.samples.T
        x, y = axes.positions(track.samples[:, 1:3]).T
        heading = axes.headings(orientation)
        along, offset, relative_heading = curve.project(x, y, heading)
        of_track = np.stack([along, offset, relative_heading, speed], axis=-1)
        states[steps.astype(int), car] = of_track
    return states


class ParallelLanes(NamedTuple):
    """Lanes side by side.

    Attributes:
        curve: of the leftmost lane.
        lanes: distance of each lane to its right [m], ascending.
    """

    curve: Curve
    lanes: Float[np.ndarray, "lanes"]


def _parallel_lanes(lines: list[Points]) -> ParallelLanes:
    """Return the lanes of the road, given the middle of each row of lanes.

    The road is the largest set of parallel lines: a ramp is parallel only to itself.
    """
    # How far each line is to the right of each curve [curves, lines].
    curves = [next(smooth_curves(line)) for line in lines]
    rows = []
    for curve in curves:
        rows.append([_offset(curve, line) for line in lines])
    offsets = np.array(rows)

    # The curve with the most parallel lines, and the leftmost one of these.
    numbers_of_parallels = np.isfinite(offsets).sum(axis=1)
    from_most = offsets[numbers_of_parallels.argmax()]
    leftmost = int(np.nanargmin(from_most))
    lanes = np.sort(offsets[leftmost])
    return ParallelLanes(curves[leftmost], lanes[np.isfinite(lanes)])


def _offset(curve: Curve, line: Points) -> float:
    """Return the median distance of a line to the right of a curve [m].

    It is NaN if the line is not parallel, or goes back. A line may be much shorter than
    the curve. A ramp that approaches is not parallel: in recording 10 of US-101, it
    comes from 40 m away, and nobody drives at its median offset of 23 m.
    """
    largest_spread = 0.5  # m, median deviation from the median of parallel lines
    along, offset = curve.locate(line)
    middle = float(np.median(offset))
    goes_on = along[-1] > along[0]
    spread = np.median(np.abs(offset - middle))
    return middle if goes_on and spread < largest_spread else np.nan
