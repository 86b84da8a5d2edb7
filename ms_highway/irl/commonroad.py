"""Convert CommonRoad scenarios, such as those of the US-101 highway, to recordings in lane coordinates."""

from pathlib import Path

import numpy as np

from ms_highway.geometry.curve import wrapped
from ms_highway.irl.recording import Recording
from ms_highway.recorded.commonroad import read_scenario, scenario_files
from ms_highway.recorded.lane_coordinates import measure_road
from ms_highway.recorded.scenario import SPEED_LIMIT, TrafficRecording


def read_directory(directory: Path, first: int | None = None) -> list[Recording]:
    """Read the CommonRoad scenarios of a directory, files ``*.xml`` and ``*.xml.gz``, in the order of their names.

    Every moving vehicle is a driver, except those seen only once or moving against the road. Road users outside
    lanes, such as pedestrians, are neighbours. Files of one recording, such as ``USA_US101-10_4_T-1`` and
    ``USA_US101-10_5_T-1``, form a group and may share tracks: a track is a driver in the first file that has it, and a
    neighbour in the others.

    Args:
        directory: of the files.
        first: number of files to read; None for all.

    Raises:
        ValueError: if there is no file, or one is no scenario with lanes, drivers and the time step 0.1 s.
        ImportError: for traffic signs, without the packages of the extra ``commonroad``.
    """
    counted: set[tuple] = set()
    recordings = []
    for path in scenario_files(directory)[:first]:
        scenario = read_scenario(path, with_problems=False)
        try:
            recordings.append(_convert(scenario, counted))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    return recordings


def _convert(scenario: TrafficRecording, counted: set[tuple]) -> Recording:
    """Convert a scenario to a recording; add its drivers to those already counted."""
    road, tracks = measure_road(scenario.lanelets), scenario.tracks
    states, drivers = np.full((1 + max(track.last for track in tracks), len(tracks), 4), np.nan), []
    for car, track in enumerate(tracks):
        time, position, (orientation, speed) = track.samples[:, 0], track.samples[:, 1:3], track.samples[:, 3:].T
        x, left, turned = road.curve.project(position[:, 0], position[:, 1], orientation)
        heading = wrapped(-turned)  # to the right here
        states[time.astype(int), car] = np.stack([x, -left, heading, speed], axis=-1)
        identity = (scenario.group, track.number, *position[0].round(2))
        along_the_road = np.abs(np.median(heading)) < np.pi / 2
        if track.drives and len(time) > 1 and along_the_road and identity not in counted:
            drivers.append(car)
            counted.add(identity)
    sizes, numbers = np.array([track.size for track in tracks]), np.array(drivers, dtype=int)
    return Recording(scenario.name, scenario.group, states, numbers, sizes, road.lanes, road.lane_width, SPEED_LIMIT)
