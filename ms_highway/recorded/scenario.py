"""Hold what a recording of traffic contains: lanelets, tracks and planning problems.

These records do not depend on the format of a file; `ms_highway.recorded.commonroad`
makes them from CommonRoad's. They are in the axes of the map, with y to the left of x,
in metres, radians and steps of time; `ms_highway.recorded.network.Axes` converts to
highway-env's axes.
"""

from math import tau
from typing import ClassVar

import msgspec
import numpy as np
from jaxtyping import Float
from matplotlib.path import Path

Points = Float[np.ndarray, "points 2"]
Point = Float[np.ndarray, "2"]


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
        limit: speed limit that its signs show [m/s], None without one.
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
        """Return samples at steps of time [steps, 5], interpolated if need be."""
        times, x, y, orientation, speed = self.samples.T
        columns = (x, y, np.unwrap(orientation), speed)
        interpolated = [np.interp(steps, times, column) for column in columns]
        return np.stack([steps, *interpolated], axis=-1)


class GoalRegion(msgspec.Struct, frozen=True):
    """Where, when and how the ego has to be to reach a goal; None is no condition.

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

    @property
    def middle_heading(self) -> float | None:
        """The middle of the interval of orientations, None without one."""
        if self.headings is None:
            return None
        first, last = self.headings
        return first + (last - first) % tau / 2

    def is_reached(
        self,
        step: int,
        point: Point,
        orientation: float,
        speed: float,
    ) -> bool:
        """Return whether an ego with its middle at a point reaches the goal."""
        return (
            self.times[0] <= step <= self.times[1]
            and self._allows_speed(speed)
            and self._allows_heading(orientation)
            and self._contains(point)
        )

    def _allows_speed(self, speed: float) -> bool:
        if self.speeds is None:
            return True
        slowest, fastest = self.speeds
        return slowest <= speed <= fastest

    def _allows_heading(self, orientation: float) -> bool:
        if self.headings is None:
            return True
        first, last = self.headings
        return (orientation - first) % tau <= (last - first) % tau

    def _contains(self, point: Point) -> bool:
        if self.area is None:
            return True
        return bool(Path(self.area).contains_points(np.array([point]))[0])


class Problem(msgspec.Struct, frozen=True):
    """A planning problem: from a start, reach one of several goals.

    Attributes:
        number: its id.
        start: x, y, orientation and speed.
        time: step of the start.
        goals: the alternatives.
        size: length and width of the ego [m]; by default those of CommonRoad's second
            vehicle, a BMW 320i.
        track: number of the recorded vehicle that the ego replaces, None if it replaces
            none.
    """

    number: int
    start: tuple[float, float, float, float]
    time: int
    goals: tuple[GoalRegion, ...]
    size: tuple[float, float] = (4.508, 1.610)
    track: int | None = None

    @property
    def last(self) -> int:
        """The last step of all goals."""
        return max(goal.times[1] for goal in self.goals)

    def is_reached(
        self,
        step: int,
        point: Point,
        orientation: float,
        speed: float,
    ) -> bool:
        """Return whether an ego with its middle at a point reaches one of the goals."""
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

    default_speed_limit: ClassVar[float] = 29.06
    """Speed limit of lanes without a traffic sign [m/s]: 65 mph, as on US-101, whose
    scenarios have no signs.
    """
    cache_size: ClassVar[int] = 20
    """Number of recordings that stay in memory, and of roads that are made of them."""

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
        for track in self.tracks:
            if track.number == number:
                return track
        return None
