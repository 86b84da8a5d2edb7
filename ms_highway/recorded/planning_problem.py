"""Choose the planning problem of an ego: one of the recording, or a vehicle's own."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np
from highway_env.utils import rect_corners

from ms_highway.game.scenario import TIME_STEP
from ms_highway.geometry.bodies import separation
from ms_highway.geometry.curve import Pose, wrapped
from ms_highway.geometry.road_map import Spot
from ms_highway.recorded.scenario import (
    GoalRegion,
    Problem,
    RecordedTrack,
    TrafficRecording,
)
from ms_highway.recorded.straight_road import StraightRoad
from ms_highway.road.timed_goal import TimedGoal


@dataclass(frozen=True)
class EgoSettings:
    """Set the goals of egos in the place of vehicles, and which vehicle an ego is."""

    extra_steps: int = 20
    """Steps by which the ego may reach the last position of a recorded vehicle later
    than that vehicle: 2 s.
    """
    goal_size: tuple[float, float] = (4.0, 3.0)
    """Length along the road and width of the region around that position [m]."""
    largest_turn: float = np.pi / 6
    """Largest difference of headings between the ego of a planning problem and the
    recorded vehicle that it is [rad].
    """


EGO = EgoSettings()


def problem_of(scenario: TrafficRecording, ego: str | int) -> Problem:
    """Return a planning problem, or the problem to go where a vehicle went.

    If the vehicle of a planning problem was recorded, too, the ego takes its place. It
    is the vehicle that drives where the problem starts, in about the same direction:
    the middle of one body is within the other, as two vehicles cannot be. Vehicles of
    other planning problems stay.

    Args:
        scenario: the recording.
        ego: ``problem`` for the first planning problem, ``problem:NUMBER``, or the
            number of a vehicle's track.

    Raises:
        ValueError: if there is no such planning problem, no such vehicle, or the
            vehicle was seen only once; if another body overlaps the ego at the start.
    """
    if isinstance(ego, str):
        problem = _planning_problem(scenario, ego)
        if problem.track is None:
            track = _recorded_as(scenario, problem)
            problem = msgspec.structs.replace(problem, track=track)
    else:
        problem = _problem_of_vehicle(scenario, ego)
    _check_start_is_free(scenario, problem, ego)
    return problem


def _planning_problem(scenario: TrafficRecording, ego: str) -> Problem:
    """Return the first planning problem of a recording, or the one with a number."""
    number = ego.partition(":")[2]
    for problem in scenario.problems:
        if number in ("", str(problem.number)):
            return problem
    choices = [f"'problem:{problem.number}'" for problem in scenario.problems]
    vehicle = next(iter(_vehicles(scenario)), "none here")
    choices.append(f"a vehicle, such as {vehicle}")
    raise ValueError(
        f"there is no planning {ego.replace(':', ' ')}, config['ego']; choose"
        f" {' or '.join(choices)}"
    )


def _problem_of_vehicle(scenario: TrafficRecording, ego: int) -> Problem:
    """Return the problem to go where a recorded vehicle went."""
    vehicles = _vehicles(scenario)
    if ego not in vehicles:
        raise ValueError(
            f"config['ego'] is {ego}, which is no vehicle that was seen twice; choose"
            f" one of {', '.join(map(str, vehicles))}"
        )
    track = vehicles[ego]
    _, *start = track.samples[0].tolist()
    _, x, y, orientation, _ = track.samples[-1].tolist()
    times = (track.first, track.last + EGO.extra_steps)
    corners = rect_corners((x, y), *EGO.goal_size, orientation)
    goal = GoalRegion(times, corners)
    return Problem(ego, tuple(start), track.first, (goal,), track.size, ego)


def _vehicles(scenario: TrafficRecording) -> Mapping[int, RecordedTrack]:
    """Return the tracks of vehicles that were seen twice or more, by their number."""
    return {
        track.number: track
        for track in scenario.tracks
        if track.drives and len(track.samples) > 1
    }


def _recorded_as(scenario: TrafficRecording, problem: Problem) -> int | None:
    """Return the number of the vehicle that a planning problem is about.

    It is None if the vehicle was not recorded.
    """
    own = problem.start[:3]
    point = np.zeros(2)  # the size of a body's middle
    distances = {}
    for track, pose in _seen(scenario, problem.time):
        own_inside = separation(own, point, pose, track.size) < 0
        other_inside = separation(own, problem.size, pose, point) < 0
        turn = abs(float(wrapped(pose[2] - own[2])))
        same_way = turn <= EGO.largest_turn
        if track.drives and same_way and (own_inside or other_inside):
            dx = pose[0] - own[0]
            dy = pose[1] - own[1]
            distances[track.number] = np.hypot(dx, dy)
    return min(distances, key=lambda number: distances[number], default=None)


def _check_start_is_free(
    scenario: TrafficRecording,
    problem: Problem,
    ego: str | int,
) -> None:
    """Raise an error for an obstacle with which the ego would collide at once."""
    for track, pose in _seen(scenario, problem.time):
        if track.number == problem.track:
            continue
        if separation(problem.start[:3], problem.size, pose, track.size) < 0:
            raise ValueError(
                f"the start of the ego, config['ego'] {ego!r}, overlaps obstacle"
                f" {track.number}; mend the file or choose another ego"
            )


def _seen(
    scenario: TrafficRecording,
    step: int,
) -> Iterator[tuple[RecordedTrack, Pose]]:
    """Yield the tracks that were seen at a step, with x, y and orientation there."""
    for track in scenario.tracks:
        if track.first <= step <= track.last:
            _, x, y, orientation, _ = track.at(np.array([step]))[0]
            yield track, (x, y, orientation)


def timed_goal(problem: Problem, road: StraightRoad) -> TimedGoal | None:
    """Return the first goal that has a region, None without one.

    Its times count from the start of the problem.
    """
    for goal in problem.goals:
        if goal.area is None:
            continue
        position = road.axes.positions(goal.area.mean(axis=0))
        heading = None
        if goal.middle_heading is not None:
            heading = float(road.axes.headings(goal.middle_heading))
        index = road.network.get_closest_lane_index(position, heading)
        place, _ = road.network.get_lane(index).local_coordinates(position)
        first_step, last_step = goal.times
        first = max(TIME_STEP * (first_step - problem.time), 0.0)
        last = max(TIME_STEP * (last_step - problem.time), 0.0)
        speeds = goal.speeds or (0.0, np.inf)
        return TimedGoal(Spot(index, place), position, (first, last), speeds)
    return None
