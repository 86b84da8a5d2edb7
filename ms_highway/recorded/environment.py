"""Drive in recorded traffic from a start to a goal in time."""

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from highway_env.envs.common.action import DiscreteMetaAction
from msgspec import Meta, Struct

from ms_highway.envs.configuration import RANGES, TYPES, Config, Types, keys_of
from ms_highway.envs.configured import ConfiguredEnv
from ms_highway.recorded.opening import SHIPPED_RECORDING, open_recording
from ms_highway.recorded.planning_problem import problem_of, timed_goal
from ms_highway.recorded.scenario import Points, Problem, TrafficRecording
from ms_highway.recorded.straight_road import StraightRoad, straight_road
from ms_highway.recorded.traffic import RecordedRoad, set_size
from ms_highway.road.stock import GoalEnv
from ms_highway.runtime.limits import Number


class RecordedSettings(Struct, frozen=True):
    """The keys of a `RecordedEnv` that highway-env does not have."""

    recording: Annotated[
        str,
        Meta(
            description=(
                f"give the file of a CommonRoad scenario, or say {SHIPPED_RECORDING!r}"
            )
        ),
    ]
    traffic: Literal["learned", "replay", "idm"]
    ego: Annotated[
        Annotated[str, Meta(pattern=r"^problem(:[0-9]+)?\Z")] | int,
        Meta(
            description=(
                "say 'problem' or 'problem:NUMBER' for a planning problem, or give the"
                " number of a recorded vehicle"
            )
        ),
    ]
    goal_reward: Number
    collision_reward: Number
    off_road_reward: Number
    progress_reward: Number


class RecordedEnv(ConfiguredEnv, GoalEnv):
    """A car in recorded traffic, with a goal.

    Its episodes are CommonRoad scenarios and their planning problems.

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
    settings: RecordedSettings
    types: ClassVar[Types] = {
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
    farthest_start: ClassVar[float] = 1.0
    """Distance of a start from the nearest lane, in its widths, beyond which the start
    is not on the road.
    """
    min_desired_speed: ClassVar[float] = 5.0
    """Least desired speed of a robot without a timed goal [m/s]: otherwise its speed at
    the start.
    """

    scenario: TrafficRecording

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
            "recording": SHIPPED_RECORDING,
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
        """Build an episode; change the environment only if everything is possible."""
        task = problem_of(scenario, self.settings.ego)
        straight = straight_road(scenario)
        x, y, orientation, speed = task.start
        position = straight.axes.positions([x, y])
        heading = float(straight.axes.headings(orientation))
        self._check_on_lane(task, straight, position, heading)

        road = RecordedRoad(
            scenario, task.time, task.track, self.settings.traffic, self.np_random
        )
        ego = self.action_type.vehicle_class(
            road, position, heading=heading, speed=speed
        )
        set_size(ego, task.size)
        ego.check_collisions = False
        road.vehicles.insert(0, ego)
        goal = timed_goal(task, straight)

        self.scenario = scenario
        self.task = task
        self.road = road
        self.axes = straight.axes
        self.goal = goal
        self.desired_speed = max(speed, self.min_desired_speed)
        self.controlled_vehicles = [ego]
        self.success = False
        self.off_road = False
        self.progress = 0.0
        self._along = float(road.states[ego][0])

    def _check_on_lane(
        self,
        task: Problem,
        straight: StraightRoad,
        position: Points,
        heading: float,
    ) -> None:
        """Raise an error unless there is a lane under the start of a problem."""
        index = straight.network.get_closest_lane_index(position, heading)
        lane = straight.network.get_lane(index)
        if lane.distance(position) > self.farthest_start * lane.width_at(0.0):
            x, y, _, _ = task.start
            raise ValueError(
                f"there is no lanelet under the start, ({x:.1f}, {y:.1f}); mend the"
                " file or leave it out"
            )

    @property
    def goal_areas(self) -> list[Points]:
        """Corners of the regions of all goals that have a region."""
        return [
            self.axes.positions(goal.area)
            for goal in self.task.goals
            if goal.area is not None
        ]

    def _simulate(self, action: object = None) -> None:
        """Let all vehicles act and move for a step, and judge where the ego is."""
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

    def _rewards(self, action: object) -> dict[str, float]:
        return {
            "goal_reward": float(self.success),
            "collision_reward": float(self.vehicle.crashed),
            "off_road_reward": float(self.off_road),
            "progress_reward": self.progress,
        }

    def _reward(self, action: object) -> float:
        rewards = self._rewards(action)
        return sum(self.config[name] * value for name, value in rewards.items())

    def _is_terminated(self) -> bool:
        return bool(self.success or self.vehicle.crashed or self.off_road)

    def _is_truncated(self) -> bool:
        return self.road.now >= self.task.last

    def _info(self, obs: object, action: object = None) -> Config:
        waiting = {track.number for track in self.road.waiting}
        is_waiting = [track.number in waiting for track in self.scenario.tracks]
        recorded = {
            "step": self.road.now,
            "success": self.success,
            "collision": bool(self.vehicle.crashed),
            "off_road": self.off_road,
            "replaced": -1 if self.task.track is None else self.task.track,
            "waiting": np.array(is_waiting),
        }
        return super()._info(obs, action) | {
            "is_success": self.success,
            "recorded": recorded,
        }
