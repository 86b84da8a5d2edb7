"""Convert CommonRoad scenarios, such as those of the US-101 highway, to recordings in lane coordinates."""

from pathlib import Path

import numpy as np

from ms_highway.irl.recording import Recording
from ms_highway.recorded.commonroad import read_scenario, scenario_files
from ms_highway.recorded.scenario import SPEED_LIMIT, TrafficRecording
from ms_highway.recorded.straight_road import straight_road


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
        ValueError: if there is no file, or one is no scenario with lanes of one direction, drivers and the time step
            0.1 s.
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
    """Convert a scenario to a recording; add its drivers to those already counted."""
    road, tracks = straight_road(scenario), scenario.tracks
    states, drivers = np.full((1 + max(track.last for track in tracks), len(tracks), 4), np.nan), []
    for car, track in enumerate(tracks):
        way = states[track.samples[:, 0].astype(int), car] = road.way(track)
        along_the_road = np.abs(np.median(way[:, 2])) < np.pi / 2
        identity = (scenario.group, track.number, *track.samples[0, 1:3].round(2))
        if track.drives and len(way) > 1 and along_the_road and identity not in counted:
            drivers.append(car)
            counted.add(identity)
    numbers = np.unique([*road.numbers.values()])
    roads = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)  # ramps, and the other direction, are separate
    lanes = road.lane_width * max(roads, key=len)
    cars = np.array(drivers, dtype=int), np.array([track.size for track in tracks])
    return Recording(scenario.name, scenario.group, states, *cars, lanes, road.lane_width, SPEED_LIMIT)
