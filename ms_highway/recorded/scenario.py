"""What a recording holds, as in CommonRoad: lanelets, tracks of vehicles and standing
objects, and planning problems.

Everything here is in the axes of the map, with y to the left of x, in metres, radians
and steps of time; see `ms_highway.recorded.network.Axes` for highway-env's axes.
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

SPEED_LIMIT = 29.06
"""Speed limit of lanes without a traffic sign [m/s]: 65 mph, as on US-101, whose
scenarios have no signs.
"""

KEPT = 20
"""Number of recordings that are kept in memory, as long as their files do not change.
"""

FULL_TURN = 2 * np.pi

CAR_SIZE = 4.508, 1.610
"""Length and width of the ego in planning problems [m]: CommonRoad's second vehicle, a
BMW 320i.
"""

SHIPPED = "us101"
"""Name of the recording that comes with the package."""


class Lanelet(msgspec.Struct, frozen=True):
    """A piece of a lane.

    Attributes:
        number: its id.
        left: its left edge, in the direction of driving.
        right: its right edge, with as many points.
        before: ids of the lanelets that lead to it.
        after: ids of the lanelets to which it leads.
        beside: ids of the lanelets to its left and right on which traffic goes the same
            way, None without one.
        limit: speed limit [m/s], None without one.
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
        """The line in its middle, in the direction of driving."""
        return (self.left + self.right) / 2


class RecordedTrack(msgspec.Struct, frozen=True):
    """A vehicle, another road user or a standing object, as it was recorded.

    Attributes:
        number: its id.
        size: length and width [m].
        samples: step of time, x, y, orientation and speed [times, 5].
        drives: whether it drives in lanes; all others, such as pedestrians, are
            replayed.
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

    def at(self, steps: np.ndarray) -> np.ndarray:
        """Return samples at steps of time [steps, 5], interpolated where it was not
        seen.
        """
        times, x, y, orientation, speed = self.samples.T
        parts = x, y, np.unwrap(orientation), speed
        return np.stack(
            [steps, *(np.interp(steps, times, part) for part in parts)], axis=-1
        )


class GoalRegion(msgspec.Struct, frozen=True):
    """Where, when and how the ego has to be to reach a goal; None stands for no
    condition.

    Attributes:
        times: first and last step.
        area: corners of the polygon that must contain the middle of the ego [corners,
            2].
        speeds: lowest and highest.
        headings: first and last orientation of an interval, counted to the left.
    """

    times: tuple[int, int]
    area: np.ndarray | None = None
    speeds: tuple[float, float] | None = None
    headings: tuple[float, float] | None = None

    def is_reached(
        self, step: int, point: Points, orientation: float, speed: float
    ) -> bool:
        """Return whether an ego with its middle at a point of the map reaches the goal."""
        low, high = self.headings or (orientation, orientation)
        slowest, fastest = self.speeds or (speed, speed)
        return (
            self.times[0] <= step <= self.times[1]
            and slowest <= speed <= fastest
            and (orientation - low) % FULL_TURN <= (high - low) % FULL_TURN
            and (self.area is None or bool(Path(self.area).contains_points([point])[0]))
        )


class Problem(msgspec.Struct, frozen=True):
    """A planning problem: from a start, reach one of several goals.

    Attributes:
        number: its id.
        start: x, y, orientation and speed.
        time: step of the start.
        goals: the alternatives.
        size: length and width of the ego [m].
        track: number of the recorded vehicle that the ego replaces, None if it replaces
            none.
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

    def is_reached(
        self, step: int, point: Points, orientation: float, speed: float
    ) -> bool:
        """Return whether an ego with its middle at a point of the map reaches one of
        the goals.
        """
        return any(
            goal.is_reached(step, point, orientation, speed) for goal in self.goals
        )


class TrafficRecording(msgspec.Struct, frozen=True, eq=False):
    """A recording of traffic.

    Attributes:
        name: of the scenario.
        group: name of the longer recording from which the scenario was cut; scenarios
            of a group may share tracks.
        source: name of its file.
        lanelets: the road.
        tracks: the vehicles, other road users and standing objects.
        problems: the planning problems.
    """

    name: str
    group: str
    source: str
    lanelets: tuple[Lanelet, ...]
    tracks: tuple[RecordedTrack, ...]
    problems: tuple[Problem, ...] = ()

    def __deepcopy__(self, memo: object) -> "TrafficRecording":
        return self  # it never changes: copies of environments share it

    def track(self, number: int) -> RecordedTrack | None:
        """Return the track with a number, None without one."""
        return next((track for track in self.tracks if track.number == number), None)


def open_recording(recording: str) -> TrafficRecording:
    """Return the recording of a CommonRoad file, or by its name the one that comes with
    the package.

    Raises:
        ValueError: naming the file and the problem.
    """
    if recording == SHIPPED:
        return _shipped_recording()
    path = pathlib.Path(recording)
    if not path.is_file():
        raise ValueError(
            f"config['recording'] is {recording!r}, which is no file; give the file of"
            f" a CommonRoad scenario, *.xml or *.xml.gz, or {SHIPPED!r}, which comes"
            " with the package"
        )
    return _read(path.resolve(), path.stat().st_mtime_ns)


@cache
def _shipped_recording() -> TrafficRecording:
    packed = (
        resources.files("ms_highway") / "data" / f"{SHIPPED}_traffic.json.gz"
    ).read_bytes()
    unpacked = gzip.decompress(packed)
    return msgspec.json.decode(
        unpacked,
        type=TrafficRecording,
        dec_hook=lambda _, numbers: np.array(numbers, float),
    )


@lru_cache(KEPT)
def _read(path: pathlib.Path, _: int) -> TrafficRecording:
    from ms_highway.recorded.commonroad import read_scenario

    return read_scenario(path)
