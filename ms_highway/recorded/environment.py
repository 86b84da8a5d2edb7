"""Recorded: drive on a recorded road, among those who were recorded there."""

from typing import Annotated, Any, Literal

import numpy as np
from highway_env.envs.common.action import DiscreteMetaAction
from msgspec import Meta, Struct

from ms_highway.envs.configuration import RANGES, TYPES, Config, Number, keys_of
from ms_highway.envs.configured import ConfiguredEnv
from ms_highway.recorded.problem import problem_of, timed_goal
from ms_highway.recorded.scenario import SHIPPED, Points, TrafficRecording, open_recording
from ms_highway.recorded.straight_road import straight_road
from ms_highway.recorded.traffic import RecordedRoad, sized
from ms_highway.road.stock import GoalEnv

EGO_REMEDY = "say 'problem' or 'problem:NUMBER' for a planning problem, or give the number of a recorded vehicle"
OFF_LANE = 1.0  # widths of a lane, from which a start is not on the road
MIN_DESIRED_SPEED = 5.0  # m/s, that a robot desires without a goal in time; otherwise its speed at the start


class RecordedSettings(Struct, frozen=True):
    """The keys of a `RecordedEnv` that highway-env does not have."""

    recording: Annotated[str, Meta(description=f"give the file of a CommonRoad scenario, or say {SHIPPED!r}")]
    traffic: Literal["learned", "replay", "idm"]
    ego: Annotated[Annotated[str, Meta(pattern=r"^problem(:[0-9]+)?\Z")] | int, Meta(description=EGO_REMEDY)]
    goal_reward: Number
    collision_reward: Number
    off_road_reward: Number
    progress_reward: Number


class RecordedEnv(ConfiguredEnv, GoalEnv):
    """A car in recorded traffic, with a goal: CommonRoad scenarios and their planning problems.

    Configuration, beside highway-env's own, of which changes act from the next reset on:

    * ``recording``: a CommonRoad scenario, ``*.xml`` or ``*.xml.gz``, or ``"us101"``, which comes with the package.
    * ``traffic``: ``"learned"``, the drivers that were learned on US-101, each with traits of its own, who react to the
      ego (`ms_highway.CommuterVehicle`); ``"replay"``, everybody goes where it went; ``"idm"``, highway-env's drivers.
      Road users outside lanes, such as pedestrians and trains, are always replayed.
    * ``ego``: ``"problem"``, the first planning problem, or ``"problem:NUMBER"``, any; or the number of a recorded
      vehicle, to start in its place and go to its own last position, at the latest 2 s after it was there.
    * ``goal_reward``, ``collision_reward``, ``off_road_reward``: once, at the end; ``progress_reward``: of each metre
      along the road.

    An episode is a success if a goal's region is reached in its interval of time, at its speed and heading, without a
    collision and without leaving the road before, by any corner. It ends then, or with the last goal's time. The road
    moves at 10 Hz, as it was recorded. Here, x goes along the road and y to its right; ``axes`` leads to the map.

    ``info["recorded"]`` says ``step``, of the recording; ``success``, ``collision``, ``off_road``; ``waiting``, for
    each of the scenario's ``tracks``, whether another vehicle blocks its entry. ``info["is_success"]`` repeats the
    success.

    Attributes:
        scenario: the recording.
        axes: of the road in the map.
        task: the planning problem of the ego.
        goal: where and when the ego has to be, None if its goal is only a time.
        success, off_road: whether the goal has been reached, and the road left.
    """

    settings_type = RecordedSettings
    scenario: TrafficRecording
    types = {  # noqa: RUF012
        "action": {
            "DiscreteMetaAction": keys_of(DiscreteMetaAction),
            "ContinuousAction": RANGES | {"dynamical": Any},
            "DiscreteAction": RANGES | {"dynamical": Any, "actions_per_axis": Any},
        },
        "observation": {name: keys for name, keys in TYPES["observation"].items() if not name.endswith("States")},
    }

    @classmethod
    def default_config(cls) -> Config:
        """highway-env's configuration with this environment's own."""
        return super().default_config() | {
            "observation": {"type": "Kinematics", "vehicles_count": 8, "absolute": False},
            "action": {"type": "DiscreteMetaAction", "target_speeds": [0, 4, 8, 12, 16, 20, 24, 28]},
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
        """Build the road, and put the ego and the others on it; all of it, or nothing changes."""
        scenario = open_recording(self.settings.recording)
        try:
            self._build(scenario)
        except ValueError as error:
            raise ValueError(f"{scenario.source}: {error}") from error

    def _build(self, scenario: TrafficRecording) -> None:
        task, straight = problem_of(scenario, self.settings.ego), straight_road(scenario)
        x, y, orientation, speed = task.start
        position, heading = straight.axes.pose(x, y, orientation)
        lane = straight.network.get_lane(straight.network.get_closest_lane_index(position, heading))
        if lane.distance(position) > OFF_LANE * lane.width_at(0.0):
            raise ValueError(f"there is no lanelet under the start, ({x:.1f}, {y:.1f}); mend the file or leave it out")
        road = RecordedRoad(scenario, task.time, task.track, self.settings.traffic, self.np_random)
        vehicle = sized(self.action_type.vehicle_class(road, position, heading=heading, speed=speed), task.size)
        vehicle.check_collisions = False
        road.vehicles.insert(0, vehicle)
        self.scenario, self.task, self.road, self.axes = scenario, task, road, straight.axes
        self.goal, self.desired_speed = timed_goal(task, straight), max(speed, MIN_DESIRED_SPEED)
        self.controlled_vehicles, self.success, self.off_road, self.progress = [vehicle], False, False, 0.0
        self._along = float(road.states[vehicle][0])

    @property
    def goal_areas(self) -> list[Points]:
        """Corners of the areas of all goals that have a place."""
        return [self.axes.positions(goal.area) for goal in self.task.goals if goal.area is not None]

    def _simulate(self, action: Any = None) -> None:
        """Let everybody act and move for a step, and judge where that has led the ego."""
        super()._simulate(action)
        ego, road = self.vehicle, self.road
        along = float(road.states[ego][0])
        self.progress, self._along = along - self._along, along
        self.off_road |= not road.straight.covers(ego.polygon()[:-1])
        orientation, point = float(self.axes.headings(ego.heading)), self.axes.points(ego.position)
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
        return sum(self.config[name] * value for name, value in self._rewards(action).items())

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
                "waiting": np.array([track.number in waiting for track in self.scenario.tracks]),
            },
        }
