"""What the ego has to do: from a start, be in a goal's region in time."""

import numpy as np
from highway_env.utils import rect_corners

from ms_highway.game.scenario import TIME_STEP
from ms_highway.geometry.road_map import Spot
from ms_highway.recorded.scenario import FULL_TURN, GoalRegion, Problem, TrafficRecording
from ms_highway.recorded.straight_road import StraightRoad
from ms_highway.road.timed_goal import TimedGoal

LATE = 20  # steps by which the ego may reach the last position of a recorded vehicle later than that vehicle
GOAL_SIZE = 4.0, 3.0  # m, length along the road and width of the region around that position


def problem_of(scenario: TrafficRecording, ego: str | int) -> Problem:
    """Return a planning problem of a scenario, or the problem to go where a recorded vehicle went.

    Args:
        scenario: the recording.
        ego: ``problem`` for the first planning problem, ``problem:NUMBER``, or the number of a vehicle's track.

    Raises:
        ValueError: if there is no such planning problem, no such vehicle, or the vehicle was seen only once.
    """
    vehicles = {track.number: track for track in scenario.tracks if track.drives and len(track.samples) > 1}
    if isinstance(ego, str):
        number = ego.partition(":")[2]
        for problem in scenario.problems:
            if number in ("", str(problem.number)):
                return problem
        known = [f"'problem:{problem.number}'" for problem in scenario.problems]
        choices = " or ".join([*known, f"a vehicle, such as {next(iter(vehicles), 'none here')}"])
        raise ValueError(f"there is no planning {ego.replace(':', ' ')}, config['ego']; choose {choices}")
    if ego not in vehicles:
        choices = ", ".join(map(str, vehicles))
        raise ValueError(f"config['ego'] is {ego}, which is no vehicle that was seen twice; choose one of {choices}")
    track = vehicles[ego]
    (_, *start), (_, x, y, orientation, _) = track.samples[[0, -1]].tolist()
    goal = GoalRegion((track.first, track.last + LATE), rect_corners((x, y), *GOAL_SIZE, orientation))
    return Problem(ego, tuple(start), track.first, (goal,), track.size, ego)


def timed_goal(problem: Problem, road: StraightRoad) -> TimedGoal | None:
    """Return where to be and when, since the start, for the first goal that has a region; None without one."""
    for goal in problem.goals:
        if goal.area is None:
            continue
        position, heading = road.axes.positions(goal.area.mean(axis=0)), None
        if goal.headings:
            low, high = goal.headings
            heading = float(road.axes.headings(low + (high - low) % FULL_TURN / 2))
        index = road.network.get_closest_lane_index(position, heading)
        place, _ = road.network.get_lane(index).local_coordinates(position)
        first, last = (max(TIME_STEP * (time - problem.time), 0.0) for time in goal.times)
        return TimedGoal(Spot(index, place), position, (first, last), goal.speeds or (0.0, np.inf))
    return None
