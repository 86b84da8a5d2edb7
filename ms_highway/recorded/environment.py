"""Drive in recorded traffic: on its road, among its vehicles, from a start to a goal in
time.
"""

from collections.abc import Iterator
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from highway_env.envs.common.action import DiscreteMetaAction
from highway_env.utils import rect_corners
from msgspec import Meta, Struct

from ms_highway.envs.configuration import RANGES, TYPES, Config, keys_of
from ms_highway.envs.configured import ConfiguredEnv
from ms_highway.game.scenario import TIME_STEP
from ms_highway.geometry.bodies import separation
from ms_highway.geometry.curve import Pose, wrapped
from ms_highway.geometry.road_map import Spot
from ms_highway.recorded.scenario import (
    FULL_TURN,
    SHIPPED,
    GoalRegion,
    Points,
    Problem,
    RecordedTrack,
    TrafficRecording,
    open_recording,
)
from ms_highway.recorded.straight_road import StraightRoad, straight_road
from ms_highway.recorded.traffic import RecordedRoad, sized
from ms_highway.road.stock import GoalEnv
from ms_highway.road.timed_goal import TimedGoal
from ms_highway.runtime.limits import Number

# Planning problems

# steps by which the ego may reach the last position of a recorded vehicle later than
# that vehicle
LATE = 20
GOAL_SIZE = (
    4.0,
    3.0,
)  # m, length along the road and width of the region around that position
SAME_HEADING = (
    np.pi / 6
)  # rad, largest turn of a recorded vehicle that is the ego of a planning problem


def problem_of(scenario: TrafficRecording, ego: str | int) -> Problem:
    """Return a planning problem of a scenario, or the problem to go where a recorded
    vehicle went.

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
    problem = _chosen(scenario, ego)
    if problem.track is None:
        problem = msgspec.structs.replace(
            problem, track=_recorded_as(scenario, problem)
        )

    # Whatever else is there would collide with the ego at once.
    for track, pose in _seen(scenario, problem.time):
        if (
            track.number != problem.track
            and separation(problem.start[:3], problem.size, pose, track.size) < 0
        ):
            place = (
                f"the start of the ego, config['ego'] {ego!r}, overlaps obstacle"
                f" {track.number}"
            )
            raise ValueError(f"{place}; mend the file or choose another ego")
    return problem


def _seen(
    scenario: TrafficRecording, step: int
) -> Iterator[tuple[RecordedTrack, Pose]]:
    """Yield the tracks that were seen at a step, with x, y and orientation there."""
    for track in scenario.tracks:
        if track.first <= step <= track.last:
            _, x, y, orientation, _ = track.at(np.array([step]))[0]
            yield track, (x, y, orientation)


def _recorded_as(scenario: TrafficRecording, problem: Problem) -> int | None:
    """Return the number of the track of the vehicle that a planning problem is about,
    None if it was not recorded.
    """
    own = problem.start[:3]
    point = np.zeros(2)
    found = {}
    for track, pose in _seen(scenario, problem.time):
        own_inside = separation(own, point, pose, track.size) < 0
        other_inside = separation(own, problem.size, pose, point) < 0
        same_way = abs(wrapped(pose[2] - own[2])) <= SAME_HEADING
        if track.drives and same_way and (own_inside or other_inside):
            found[track.number] = np.hypot(pose[0] - own[0], pose[1] - own[1])
    return min(found, key=lambda number: found[number], default=None)


def _chosen(scenario: TrafficRecording, ego: str | int) -> Problem:
    """Return the problem of an ego as the recording has it; see `problem_of`."""
    vehicles = {
        track.number: track
        for track in scenario.tracks
        if track.drives and len(track.samples) > 1
    }
    if isinstance(ego, str):
        number = ego.partition(":")[2]
        for problem in scenario.problems:
            if number in ("", str(problem.number)):
                return problem
        known = [f"'problem:{problem.number}'" for problem in scenario.problems]
        choices = " or ".join(
            [*known, f"a vehicle, such as {next(iter(vehicles), 'none here')}"]
        )
        raise ValueError(
            f"there is no planning {ego.replace(':', ' ')}, config['ego']; choose"
            f" {choices}"
        )
    if ego not in vehicles:
        choices = ", ".join(map(str, vehicles))
        raise ValueError(
            f"config['ego'] is {ego}, which is no vehicle that was seen twice; choose"
            f" one of {choices}"
        )
    track = vehicles[ego]
    (_, *start), (_, x, y, orientation, _) = track.samples[[0, -1]].tolist()
    goal = GoalRegion(
        (track.first, track.last + LATE), rect_corners((x, y), *GOAL_SIZE, orientation)
    )
    return Problem(ego, tuple(start), track.first, (goal,), track.size, ego)


def timed_goal(problem: Problem, road: StraightRoad) -> TimedGoal | None:
    """Return where to be and when, since the start, for the first goal that has a
    region; None without one.
    """
    for goal in problem.goals:
        if goal.area is None:
            continue
        position = road.axes.positions(goal.area.mean(axis=0))
        heading = None
        if goal.headings:
            low, high = goal.headings
            heading = float(road.axes.headings(low + (high - low) % FULL_TURN / 2))
        index = road.network.get_closest_lane_index(position, heading)
        place, _ = road.network.get_lane(index).local_coordinates(position)
        first, last = (
            max(TIME_STEP * (time - problem.time), 0.0) for time in goal.times
        )
        return TimedGoal(
            Spot(index, place), position, (first, last), goal.speeds or (0.0, np.inf)
        )
    return None


# The environment

EGO_REMEDY = (
    "say 'problem' or 'problem:NUMBER' for a planning problem, or give the number of a"
    " recorded vehicle"
)
# distance of a start from the nearest lane, in its widths, beyond which the start is
# not on the road
OFF_LANE = 1.0
# m/s, least desired speed of a robot without a timed goal: otherwise its speed at the
# start
MIN_DESIRED_SPEED = 5.0


class RecordedSettings(Struct, frozen=True):
    """The keys of a `RecordedEnv` that highway-env does not have."""

    recording: Annotated[
        str,
        Meta(description=f"give the file of a CommonRoad scenario, or say {SHIPPED!r}"),
    ]
    traffic: Literal["learned", "replay", "idm"]
    ego: Annotated[
        Annotated[str, Meta(pattern=r"^problem(:[0-9]+)?\Z")] | int,
        Meta(description=EGO_REMEDY),
    ]
    goal_reward: Number
    collision_reward: Number
    off_road_reward: Number
    progress_reward: Number


class RecordedEnv(ConfiguredEnv, GoalEnv):
    """A car in recorded traffic, with a goal: CommonRoad scenarios and their planning
    problems.

    Configuration, beside highway-env's own; changes take effect at the next reset:

    * ``recording``: a CommonRoad scenario, ``*.xml`` or ``*.xml.gz``, or ``"us101"``,
      which comes with the package.
    * ``traffic``: ``"learned"``, drivers that were learned on US-101, who react to the
      ego and each have traits of their own (`ms_highway.vehicle.FollowingVehicle`);
      ``"replay"``, every vehicle moves as it was recorded; ``"idm"``, highway-env's
      drivers. Road users outside lanes, such as pedestrians and trains, are always
      replayed.
    * ``ego``: ``"problem"`` for the first planning problem, or ``"problem:NUMBER"`` for
      any; or the number of a recorded vehicle: the ego starts in its place, and must be
      at its last position at most 2 s after it was there. If the vehicle of a planning
      problem was recorded, too, the ego takes its place; any other obstacle that
      overlaps the ego at the start is an error.
    * ``goal_reward``, ``collision_reward``, ``off_road_reward``: earned once, at the
      end; ``progress_reward``: earned for each metre along the road.

    An episode is a success if the ego is in a goal's region within the goal's intervals
    of time, speed and heading, and has neither collided nor left the road with any
    corner before. An episode ends with a success, a collision, leaving the road, or the
    last time of all goals. The road moves at 10 Hz, as it was recorded. x goes along
    the road and y to its right; ``axes`` converts to the map.

    ``info["recorded"]`` has ``step``, of the recording; ``success``, ``collision`` and
    ``off_road``; ``replaced``, the number of the recorded vehicle whose place the ego
    has taken, -1 for none; and ``waiting``: for each of the scenario's ``tracks``,
    whether another vehicle blocks its entry. ``info["is_success"]`` repeats the
    success.

    Attributes:
        scenario: the recording.
        axes: conversion between the axes of the map and highway-env's.
        task: the planning problem of the ego.
        goal: where and when the ego has to be, None if its goal is only a time.
        success, off_road: whether the ego has reached the goal, and whether it has left
            the road.
    """

    settings_type = RecordedSettings
    scenario: TrafficRecording
    types = {  # noqa: RUF012
        "action": {
            "DiscreteMetaAction": keys_of(DiscreteMetaAction),
            "ContinuousAction": RANGES | {"dynamical": Any},
            "DiscreteAction": RANGES | {"dynamical": Any, "actions_per_axis": Any},
        },
        "observation": {
            name: keys
            for name, keys in TYPES["observation"].items()
            if not name.endswith("States")
        },
    }

    @classmethod
    def default_config(cls) -> Config:
        """highway-env's configuration with this environment's own."""
        return super().default_config() | {
            "observation": {
                "type": "Kinematics",
                "vehicles_count": 8,
                "absolute": False,
            },
            "action": {
                "type": "DiscreteMetaAction",
                "target_speeds": [0, 4, 8, 12, 16, 20, 24, 28],
            },
            "recording": SHIPPED,
            "traffic": "learned",
            "ego": "problem",
            "goal_reward": 1.0,
            "collision_reward": -1.0,
            "off_road_reward": -1.0,
            "progress_reward": 0.002,
            "screen_width": 960,
            "screen_height": 280,
            "scaling": 6.0,
            "centering_position": [0.4, 0.5],
        }

    def _reset(self) -> None:
        """Build the road and its vehicles; if that fails, nothing has changed."""
        scenario = open_recording(self.settings.recording)
        try:
            self._build(scenario)
        except ValueError as error:
            raise ValueError(f"{scenario.source}: {error}") from error

    def _build(self, scenario: TrafficRecording) -> None:
        task = problem_of(scenario, self.settings.ego)
        straight = straight_road(scenario)
        x, y, orientation, speed = task.start
        position = straight.axes.positions([x, y])
        heading = float(straight.axes.headings(orientation))
        lane = straight.network.get_lane(
            straight.network.get_closest_lane_index(position, heading)
        )
        if lane.distance(position) > OFF_LANE * lane.width_at(0.0):
            raise ValueError(
                f"there is no lanelet under the start, ({x:.1f}, {y:.1f}); mend the"
                " file or leave it out"
            )
        road = RecordedRoad(
            scenario, task.time, task.track, self.settings.traffic, self.np_random
        )
        vehicle = sized(
            self.action_type.vehicle_class(
                road, position, heading=heading, speed=speed
            ),
            task.size,
        )
        vehicle.check_collisions = False
        road.vehicles.insert(0, vehicle)
        self.scenario = scenario
        self.task = task
        self.road = road
        self.axes = straight.axes
        self.goal = timed_goal(task, straight)
        self.desired_speed = max(speed, MIN_DESIRED_SPEED)
        self.controlled_vehicles = [vehicle]
        self.success = False
        self.off_road = False
        self.progress = 0.0
        self._along = float(road.states[vehicle][0])

    @property
    def goal_areas(self) -> list[Points]:
        """Corners of the regions of all goals that have a region."""
        return [
            self.axes.positions(goal.area)
            for goal in self.task.goals
            if goal.area is not None
        ]

    def _simulate(self, action: Any = None) -> None:
        """Let all vehicles act and move for a step; find out whether the ego has
        reached the goal or left the road.
        """
        super()._simulate(action)
        ego = self.vehicle
        road = self.road
        along = float(road.states[ego][0])
        self.progress = along - self._along
        self._along = along
        self.off_road |= not road.straight.covers(ego.polygon()[:-1])
        orientation = float(self.axes.headings(ego.heading))
        point = self.axes.points(ego.position)
        reached = self.task.is_reached(road.now, point, orientation, ego.speed)
        self.success |= reached and not ego.crashed and not self.off_road

    def _rewards(self, action: Any) -> dict[str, float]:
        return {
            "goal_reward": float(self.success),
            "collision_reward": float(self.vehicle.crashed),
            "off_road_reward": float(self.off_road),
            "progress_reward": self.progress,
        }

    def _reward(self, action: Any) -> float:
        return sum(
            self.config[name] * value for name, value in self._rewards(action).items()
        )

    def _is_terminated(self) -> bool:
        return bool(self.success or self.vehicle.crashed or self.off_road)

    def _is_truncated(self) -> bool:
        return self.road.now >= self.task.last

    def _info(self, obs: Any, action: Any = None) -> Config:
        waiting = {track.number for track in self.road.waiting}
        return super()._info(obs, action) | {
            "is_success": self.success,
            "recorded": {
                "step": self.road.now,
                "success": self.success,
                "collision": bool(self.vehicle.crashed),
                "off_road": self.off_road,
                "replaced": -1 if self.task.track is None else self.task.track,
                "waiting": np.array(
                    [track.number in waiting for track in self.scenario.tracks]
                ),
            },
        }
