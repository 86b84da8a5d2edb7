"""What a recording holds: lanelets, tracks of vehicles and of what stands, and planning problems, as in CommonRoad.

Everything here is in the map's own axes, y to the left of x, metres, radians and steps of time; see
`ms_highway.recorded.network.Axes` for highway-env's.
"""

import gzip
import pathlib
from functools import cache, lru_cache
from importlib import resources

import msgspec
import numpy as np
from jaxtyping import Float
from matplotlib.path import Path

Points = Float[np.ndarray, "points 2"]

SPEED_LIMIT = 29.06  # m/s, 65 mph: on US-101, whose scenarios have no traffic signs

KEPT = 20  # recordings that are kept in memory, as long as their files do not change

FULL_TURN = 2 * np.pi

CAR_SIZE = 4.508, 1.610
"""Length and width of the car of planning problems, CommonRoad's second vehicle, a BMW 320i [m]."""

SHIPPED = "us101"
"""Name of the recording that comes with the package."""


class Lanelet(msgspec.Struct, frozen=True):
    """A piece of a lane.

    Attributes:
        number: its identifier.
        left: its left edge, in the direction of driving.
        right: its right edge, with as many points.
        before: lanelets that lead to it.
        after: lanelets that it leads to.
        beside: the lanelets to its left and right on which traffic goes the same way, None without one.
        limit: of speed [m/s], None without one.
    """

    number: int
    left: np.ndarray
    right: np.ndarray
    before: tuple[int, ...] = ()
    after: tuple[int, ...] = ()
    beside: tuple[int | None, int | None] = (None, None)
    limit: float | None = None

    @property
    def centre(self) -> Points:
        """The line in its middle."""
        return (self.left + self.right) / 2


class RecordedTrack(msgspec.Struct, frozen=True):
    """A vehicle, a road user of another kind, or what stands, as it was recorded.

    Attributes:
        number: its identifier.
        size: length and width [m].
        samples: step of time, x, y, orientation and speed [times, 5].
        drives: whether it drives in lanes; others, such as pedestrians, are replayed.
    """

    number: int
    size: tuple[float, float]
    samples: np.ndarray
    drives: bool = True

    @property
    def first(self) -> int:
        """The first step at which it was seen."""
        return int(self.samples[0, 0])

    @property
    def last(self) -> int:
        """The last step at which it was seen."""
        return int(self.samples[-1, 0])


class GoalRegion(msgspec.Struct, frozen=True):
    """A region to be in at one of some steps of time; None stands for any.

    Attributes:
        times: first and last step.
        area: corners of the polygon that the middle of the ego has to be in [corners, 2].
        speeds: lowest and highest.
        headings: from one orientation, to the left, to another.
    """

    times: tuple[int, int]
    area: np.ndarray | None = None
    speeds: tuple[float, float] | None = None
    headings: tuple[float, float] | None = None

    def is_reached(self, step: int, point: Points, orientation: float, speed: float) -> bool:
        """Return whether the middle of the ego has reached it."""
        low, high = self.headings or (orientation, orientation)
        slowest, fastest = self.speeds or (speed, speed)
        in_time, as_fast = self.times[0] <= step <= self.times[1], slowest <= speed <= fastest
        heads = (orientation - low) % FULL_TURN <= (high - low) % FULL_TURN
        there = self.area is None or bool(Path(self.area).contains_points([point])[0])
        return in_time and as_fast and heads and there


class Problem(msgspec.Struct, frozen=True):
    """A planning problem: from a start, reach one of some goals.

    Attributes:
        number: its identifier.
        start: x, y, orientation and speed.
        time: step of the start.
        goals: of which one is enough.
        size: length and width of the ego [m].
        track: number of the recorded vehicle whose place it takes, None if it is nobody's.
    """

    number: int
    start: tuple[float, float, float, float]
    time: int
    goals: tuple[GoalRegion, ...]
    size: tuple[float, float] = CAR_SIZE
    track: int | None = None

    @property
    def last(self) -> int:
        """The last step of all goals."""
        return max(goal.times[1] for goal in self.goals)

    def is_reached(self, step: int, point: Points, orientation: float, speed: float) -> bool:
        """Return whether one of the goals is reached, by the middle of the ego, in the map's axes."""
        return any(goal.is_reached(step, point, orientation, speed) for goal in self.goals)


class TrafficRecording(msgspec.Struct, frozen=True, eq=False):
    """A recording of traffic.

    Attributes:
        name: of the scenario.
        group: of the recording that it is cut from; others of the group may share tracks.
        source: the file that it was read from.
        lanelets: the road.
        tracks: the vehicles.
        problems: of planning.
    """

    name: str
    group: str
    source: str
    lanelets: tuple[Lanelet, ...]
    tracks: tuple[RecordedTrack, ...]
    problems: tuple[Problem, ...] = ()

    def __deepcopy__(self, memo: object) -> "TrafficRecording":
        return self  # what never changes is shared by copies of environments

    def track(self, number: int) -> RecordedTrack | None:
        """Return the track with a number, None without one."""
        return next((track for track in self.tracks if track.number == number), None)


@cache
def shipped() -> TrafficRecording:
    """Return the recording that comes with the package, which needs no other package to be read."""
    file = resources.files("ms_highway") / "data" / f"{SHIPPED}_traffic.json.gz"
    return msgspec.json.decode(
        gzip.decompress(file.read_bytes()), type=TrafficRecording, dec_hook=lambda _, numbers: np.array(numbers, float)
    )


def open_recording(recording: str) -> TrafficRecording:
    """Return a recording: that of a CommonRoad file, or the one that comes with the package, by its name.

    Raises:
        ValueError: naming the file and what is wrong with it.
    """
    if recording == SHIPPED:
        return shipped()
    path = pathlib.Path(recording)
    if not path.is_file():
        raise ValueError(
            f"config['recording'] is {recording!r}, which is no file; give that of a CommonRoad scenario, *.xml or "
            f"*.xml.gz, or {SHIPPED!r}, which comes with the package"
        )
    return _read(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(KEPT)
def _read(path: pathlib.Path, _: int) -> TrafficRecording:
    from ms_highway.recorded.commonroad import read_scenario

    return read_scenario(path)
