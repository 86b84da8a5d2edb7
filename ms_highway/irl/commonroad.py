"""Convert CommonRoad scenarios, such as those of the US-101 highway, to recordings in
lane coordinates.
"""

from pathlib import Path

import numpy as np

from ms_highway.geometry.curve import Curve
from ms_highway.irl.recording import Recording, fingerprint
from ms_highway.recorded.commonroad import read_scenario, scenario_files
from ms_highway.recorded.network import smooth_curves
from ms_highway.recorded.scenario import Points, TrafficRecording
from ms_highway.recorded.straight_road import straight_road
from ms_highway.runtime.arrays import Vector

# m, median deviation from the median offset between two lanes, above which they are not
# parallel
LANE_SPREAD = 0.5


def read_directory(directory: Path, first: int | None = None) -> list[Recording]:
    """Read the CommonRoad scenarios of a directory, files ``*.xml`` and ``*.xml.gz``,
    in the order of their names.

    Every vehicle that drives in lanes is a driver, unless it was seen only once or with
    a gap, or drives against the road; all other road users are only neighbours. Files
    cut from one recording, such as ``USA_US101-10_4_T-1`` and ``USA_US101-10_5_T-1``,
    form a group and may share tracks: a track is a driver in the first file that has
    it, and only a neighbour in the others.

    Args:
        directory: of the files.
        first: number of files to read; None for all.

    Raises:
        ValueError: if there is no file, or a file is not a scenario with lanes, drivers
            and the time step 0.1 s.
    """
    counted = set[tuple]()
    recordings = []
    for path in scenario_files(directory)[:first]:
        scenario = read_scenario(path)
        try:
            recordings.append(_convert(scenario, counted))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    return recordings


def _convert(scenario: TrafficRecording, counted: set[tuple]) -> Recording:
    """Convert a scenario to a recording; add its drivers to those that earlier files
    have counted.
    """
    road = straight_road(scenario)
    tracks = scenario.tracks
    curve, lanes = _parallel_lanes(road.lines)
    states = np.full((1 + max(track.last for track in tracks), len(tracks), 4), np.nan)
    drivers = []
    labels = [f"obstacle {track.number}" for track in tracks]
    left_out = {}
    for car, track in enumerate(tracks):
        times, *_, orientation, speed = track.samples.T
        x, y = road.axes.positions(track.samples[:, 1:3]).T
        along, aside, heading = curve.project(x, y, road.axes.headings(orientation))
        states[times.astype(int), car] = np.stack(
            [along, aside, heading, speed], axis=-1
        )
        identity = (scenario.group, track.number, *track.samples[0, 1:3].round(2))
        with_the_road = np.abs(np.median(heading)) < np.pi / 2
        if (
            track.drives
            and len(times) > 1
            and with_the_road
            and identity not in counted
        ):
            counted.add(identity)
            if np.ptp(times) < len(times):
                drivers.append(car)
            else:
                left_out[labels[car]] = (
                    f"was not seen at each step from {times[0]:g} to {times[-1]:g}"
                )
    cars = np.array(drivers, dtype=int), np.array([track.size for track in tracks])
    width = float(np.median(np.diff(lanes))) if len(lanes) > 1 else road.lane_width
    content = fingerprint(np.concatenate([track.samples for track in tracks]))
    return Recording(
        scenario.name,
        scenario.group,
        states,
        *cars,
        lanes,
        width,
        TrafficRecording.default_speed_limit,
        labels=labels,
        fingerprint=content,
        left_out=left_out,
    )


def _parallel_lanes(lines: list[Points]) -> tuple[Curve, Vector]:
    """Return the curve of the leftmost lane of the road, and the distance of each lane
    to its right [m], ascending.

    The road is the largest set of parallel lines: a ramp is parallel only to itself.
    """
    curves = [next(smooth_curves(line)) for line in lines]
    offsets = np.array([[_offset(curve, line) for line in lines] for curve in curves])
    most = offsets[np.isfinite(offsets).sum(axis=1).argmax()]
    leftmost = int(np.nanargmin(most))
    lanes = np.sort(offsets[leftmost])
    return curves[leftmost], lanes[np.isfinite(lanes)]


def _offset(curve: Curve, line: Points) -> float:
    """Return the median distance of a line to the right of a curve [m]; NaN if it is
    not parallel, or goes back.

    A line may be much shorter than the curve. A ramp that approaches is not parallel:
    in recording 10 of US-101, it comes from 40 m away, and nobody drives at its median
    offset of 23 m.
    """
    along, aside = curve.locate(line)
    middle = float(np.median(aside))
    parallel = along[-1] > along[0] and np.median(np.abs(aside - middle)) < LANE_SPREAD
    return middle if parallel else np.nan
