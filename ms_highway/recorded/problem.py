"""What the ego has to do: from a start, be in a goal's region in time."""

from dataclasses import dataclass

import numpy as np
from highway_env.utils import rect_corners
from matplotlib.path import Path

from ms_highway.game.scenario import TIME_STEP
from ms_highway.geometry.road_map import Spot
from ms_highway.recorded.scenario import GoalRegion, Points, Problem, RecordedTrack, TrafficRecording
from ms_highway.recorded.straight_road import StraightRoad
from ms_highway.road.timed_goal import TimedGoal

CAR_SIZE = 4.508, 1.610
"""Length and width of the car of planning problems, CommonRoad's second vehicle, a BMW 320i [m]."""

LATE = 20  # steps after a recorded vehicle was at its last position, until which that counts
LENGTH_OF_GOAL = 4.0  # m, along the road, of the region around that position
SAME_LANE = 3.0  # m, its width
FULL_TURN = 2 * np.pi


@dataclass(frozen=True)
class Task:
    """What the ego has to do.

    Attributes:
        problem: from where, and to which goals.
        size: length and width of the ego [m].
        track: number of the recorded vehicle whose place it takes, None if it is nobody's.
    """

    problem: Problem
    size: tuple[float, float]
    track: int | None = None

    @classmethod
    def of(cls, scenario: TrafficRecording, ego: str | int) -> "Task":
        """Return a planning problem of a scenario, or the task to go where a recorded vehicle went.

        Args:
            scenario: the recording.
            ego: ``problem`` for the first planning problem, ``problem:NUMBER``, or the number of a vehicle's track.

        Raises:
            ValueError: if there is no such planning problem, or no such vehicle, or it was seen once only.
        """
        vehicles = {track.number: track for track in scenario.tracks if track.drives and len(track.samples) > 1}
        if isinstance(ego, str):
            number = ego.partition(":")[2]
            problems = [problem for problem in scenario.problems if number in ("", str(problem.number))]
            if not problems:
                known = [f"'problem:{problem.number}'" for problem in scenario.problems]
                choices = " or ".join([*known, f"a vehicle, such as {next(iter(vehicles), 'none here')}"])
                raise ValueError(f"there is no planning {ego.replace(':', ' ')}, config['ego']; choose {choices}")
            return cls(problems[0], CAR_SIZE)
        if ego not in vehicles:
            raise ValueError(
                f"config['ego'] is {ego}, which is no vehicle that was seen twice; choose one of "
                + ", ".join(map(str, vehicles))
            )
        return cls(_as_recorded(vehicles[ego]), vehicles[ego].size, ego)

    @property
    def last(self) -> int:
        """The last step of all goals."""
        return max(goal.times[1] for goal in self.problem.goals)

    def is_reached(self, step: int, point: Points, orientation: float, speed: float) -> bool:
        """Return whether one of the goals is reached, by the middle of the ego, in the map's axes."""
        return any(_is_in(goal, step, point, orientation, speed) for goal in self.problem.goals)

    def timed_goal(self, road: StraightRoad) -> TimedGoal | None:
        """Return where to be and when, since the start, for the first goal that has a place; None without one."""
        axes, network = road.axes, road.network
        for goal in self.problem.goals:
            if goal.area is None:
                continue
            position = axes.positions(goal.area.mean(axis=0))
            low, high = goal.headings or (0.0, 0.0)
            heading = float(axes.headings(low + (high - low) % FULL_TURN / 2)) if goal.headings else None
            index = network.get_closest_lane_index(position, heading)
            place, _ = network.get_lane(index).local_coordinates(position)
            times = [max(TIME_STEP * (time - self.problem.time), 0.0) for time in goal.times]
            return TimedGoal(Spot(index, place), position, (times[0], times[1]), goal.speeds or (0.0, np.inf))
        return None


def _as_recorded(track: RecordedTrack) -> Problem:
    """Return the task to be where a vehicle was seen last."""
    x, y, orientation, speed = track.samples[0, 1:].tolist()
    area = rect_corners(track.samples[-1, 1:3], LENGTH_OF_GOAL, SAME_LANE, track.samples[-1, 3])
    goal = GoalRegion((track.first, track.last + LATE), area)
    return Problem(track.number, (x, y, orientation, speed), track.first, (goal,))


def _is_in(goal: GoalRegion, step: int, point: Points, orientation: float, speed: float) -> bool:
    low, high = goal.headings or (0.0, 0.0)
    slowest, fastest = goal.speeds or (speed, speed)
    in_time, as_fast = goal.times[0] <= step <= goal.times[1], slowest <= speed <= fastest
    heads = not goal.headings or (orientation - low) % FULL_TURN <= (high - low) % FULL_TURN
    there = goal.area is None or bool(Path(goal.area).contains_points([point])[0])
    return in_time and as_fast and heads and there
