"""Choose what to drive in recordings, their planning problems or lane changes, and drive as recorded vehicles did."""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ms_highway.benchmarks.road.peers import Peer
from ms_highway.game.scenario import TIME_STEP
from ms_highway.recorded.commonroad import scenario_files
from ms_highway.recorded.environment import RecordedEnv
from ms_highway.recorded.scenario import SHIPPED, RecordedTrack, TrafficRecording, open_recording
from ms_highway.recorded.straight_road import straight_road
from ms_highway.recorded.traffic import GuidedVehicle
from ms_highway.road.stock import replace_ego

LONG_ENOUGH = 2.5  # s, that a vehicle has to be seen
CENTRED, CHANGED = 0.45, 0.5  # widths of a lane: from its middle, within which a vehicle is in it; and moved aside


class RecordedStart(NamedTuple):
    """Where an episode begins.

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
        """What the environment's configuration says of it."""
        return {"recording": self.recording, "ego": self.ego}


def starts_of(data: Path | None, egos: str) -> list[RecordedStart]:
    """Return the starts in a directory of recordings, by default in that of the package.

    Args:
        data: the directory.
        egos: ``problem``, the planning problems of each; ``changing``, all vehicles that end in another lane than they
            began in.

    Raises:
        ValueError: if there is no recording, or no start in any.
    """
    starts: dict[tuple, RecordedStart] = {}
    for recording in [SHIPPED] if data is None else map(str, scenario_files(data)):
        scenario = open_recording(recording)
        if egos == "changing":
            for track in filter(partial(_changes_lane, scenario), scenario.tracks):
                place = tuple(track.samples[0, 1:3].round(2))  # files of a group may share tracks
                start = RecordedStart(f"{scenario.name}_{track.number}", recording, track.number)
                starts.setdefault((scenario.group, track.number, place), start)
            continue
        for problem in scenario.problems:
            name = scenario.name if len(scenario.problems) == 1 else f"{scenario.name}_{problem.number}"
            starts[recording, problem.number] = RecordedStart(name, recording, f"problem:{problem.number}")
    if not starts:
        what = "planning problem" if egos == "problem" else "vehicle that changes lanes"
        raise ValueError(f"--data: there is no {what} in {data or 'the recording of the package'}; give another place")
    return list(starts.values())


def _changes_lane(scenario: TrafficRecording, track: RecordedTrack) -> bool:
    """Return whether a vehicle ends in another lane than it began in."""
    samples = track.samples
    if not track.drives or samples[-1, 0] - samples[0, 0] < 10 * LONG_ENOUGH:
        return False
    road = straight_road(scenario)
    begin, end = road.way(track)[[0, -1], 1] / road.lane_width
    return round(begin) != round(end) and abs(end - round(end)) < CENTRED and abs(end - begin) > CHANGED


class Human(Peer):
    """Drive as the recorded vehicle that the ego replaces, and then straight on.

    Raises:
        ValueError: from a reset, for a planning problem, where the ego replaces no vehicle.
    """

    def begin(self) -> None:
        """Put a vehicle that moves to given states in the place of the ego."""
        env = self.inner
        if not isinstance(env, RecordedEnv) or env.task.track is None:
            raise ValueError("the driver human goes as a recorded vehicle did; say --egos changing")
        self._track: Any = env.scenario.track(env.task.track)
        replace_ego(env, lambda old: GuidedVehicle(old.road, old.position, old.heading, old.speed))

    def choose(self) -> Any:
        """Give the ego the recorded state at the end of the step."""
        road, last = self.inner.road, int(self._track.samples[-1, 0])
        position, heading, speed = road.recorded_state(self._track, road.now + 1)
        beyond = TIME_STEP * max(road.now + 1 - last, 0) * speed
        self.inner.vehicle.coming = position + beyond * np.array([np.cos(heading), np.sin(heading)]), heading, speed
        return super().choose()
