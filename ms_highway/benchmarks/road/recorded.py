"""Choose the starts of episodes in recordings: planning problems, or vehicles that change lanes."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

from ms_highway.recorded.commonroad import scenario_files
from ms_highway.recorded.scenario import SHIPPED, RecordedTrack, TrafficRecording, open_recording
from ms_highway.recorded.straight_road import straight_road

LONG_ENOUGH = 2.5  # s, shortest track of a vehicle
CENTRED, CHANGED = 0.45, 0.5  # widths of a lane: largest final offset from its middle, and smallest lateral motion


class RecordedStart(NamedTuple):
    """The start of an episode.

    Attributes:
        name: for logs and files.
        recording: a file, or the name of a recording of the package.
        ego: as in the environment's configuration: ``problem:NUMBER``, or the number of a recorded vehicle.
    """

    name: str
    recording: str
    ego: str | int

    @property
    def config(self) -> dict:
        """Its part of the environment's configuration."""
        return {"recording": self.recording, "ego": self.ego}


def starts_of(data: Path | None, egos: str) -> list[RecordedStart]:
    """Return the starts in a directory of recordings, by default in that of the package.

    Args:
        data: the directory.
        egos: ``problem`` for all planning problems, ``changing`` for all vehicles that change lanes.

    Raises:
        ValueError: if there is no recording, or no start in any.
    """
    starts: dict[tuple, RecordedStart] = {}
    for recording in [SHIPPED] if data is None else map(str, scenario_files(data)):
        scenario = open_recording(recording)
        if egos == "changing":
            for track in filter(partial(_changes_lane, scenario), scenario.tracks):
                place = tuple(track.samples[0, 1:3].round(2))  # files of the same group may share tracks
                start = RecordedStart(f"{scenario.name}_{track.number}", recording, track.number)
                starts.setdefault((scenario.group, track.number, place), start)
            continue
        for problem in scenario.problems:
            name = scenario.name if len(scenario.problems) == 1 else f"{scenario.name}_{problem.number}"
            starts[recording, problem.number] = RecordedStart(name, recording, f"problem:{problem.number}")
    if not starts:
        what = "planning problem" if egos == "problem" else "vehicle that changes lanes"
        raise ValueError(
            f"--data: there is no {what} in {data or 'the recording of the package'}; give another directory"
        )
    return list(starts.values())


def _changes_lane(scenario: TrafficRecording, track: RecordedTrack) -> bool:
    """Return whether the first and the last lane of a vehicle differ."""
    samples = track.samples
    if not track.drives or samples[-1, 0] - samples[0, 0] < 10 * LONG_ENOUGH:
        return False
    road = straight_road(scenario)
    begin, end = road.way(track)[[0, -1], 1] / road.lane_width
    return round(begin) != round(end) and abs(end - round(end)) < CENTRED and abs(end - begin) > CHANGED
