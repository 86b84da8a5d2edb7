"""Make drivers from outside this package, and choose recorded starts.

The drivers are highway-env's, trained agents and recorded humans. Starts in recordings
are planning problems, or vehicles that change lanes.
"""

from collections import Counter
from copy import deepcopy
from pathlib import Path
from time import perf_counter
from typing import ClassVar, NamedTuple, SupportsFloat

import gymnasium as gym
import numpy as np
from highway_env.envs import ExitEnv
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import MDPVehicle

from ms_highway.envs.agents import check_spaces, policy_of
from ms_highway.recorded.commonroad import scenario_files
from ms_highway.recorded.environment import RecordedEnv
from ms_highway.recorded.opening import SHIPPED_RECORDING, open_recording
from ms_highway.recorded.planning_problem import problem_of
from ms_highway.recorded.scenario import RecordedTrack, TrafficRecording
from ms_highway.recorded.straight_road import straight_road
from ms_highway.recorded.traffic import ReplayedVehicle
from ms_highway.road.driven import placeholder_action
from ms_highway.road.stock import desired_speed_of, destination_of, replace_ego
from ms_highway.road.timed_goal import TimedGoal
from ms_highway.vehicle import CommuterVehicle
from ms_highway.vehicle.bicycle import OfferedSpeeds


class Peer(gym.Wrapper):
    """Drive the ego of a stock environment; the action of `step` is ignored.

    ``info["road"]`` has the durations of the decisions of a step in ``decisions`` [s].

    Args:
        env: the environment.

    Attributes:
        inner: the environment without its wrappers.
        observation: the last one.
        decisions: durations of decisions in this step that the ego itself makes in its
            frames [s].
    """

    observation: object

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.inner: AbstractEnv = env.unwrapped
        self.decisions: list[float] = []

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict | None = None,
    ) -> tuple[object, dict]:
        """Start an episode."""
        self.observation, info = super().reset(seed=seed, options=options)
        self.begin()
        return self.observation, info

    def step(
        self,
        action: object = None,
    ) -> tuple[object, SupportsFloat, bool, bool, dict]:
        """Decide, and take a step of the environment."""
        self.decisions.clear()
        start = perf_counter()
        chosen = self.choose()
        seconds = perf_counter() - start
        self.observation, reward, terminated, truncated, info = super().step(chosen)
        # An ego that drives itself has decided in its frames.
        road = {"decisions": list(self.decisions) or [seconds]}
        return self.observation, reward, terminated, truncated, {**info, "road": road}

    def begin(self) -> None:
        """Prepare an episode after its reset."""

    def choose(self) -> object:
        """Return the action of the coming step.

        By default, it is a placeholder for an ego that drives itself.
        """
        return placeholder_action(self.inner.action_type)


class Agent(Peer):
    """Take the actions of an agent, see `ms_highway.envs.agents`.

    Args:
        env: the environment.
        name: of the agent, or its file.

    Raises:
        ModuleNotFoundError: for a file, without stable-baselines3.
        ValueError: if the file is no agent, or the agent knows other observations or
            actions.
    """

    def __init__(self, env: gym.Env, name: str) -> None:
        super().__init__(env)
        check_spaces(name, env)
        self.policy = policy_of(name)

    def choose(self) -> object:
        """Return the agent's action for the last observation."""
        # Others hold the observation, too, and the agent may change it.
        return self.policy(deepcopy(self.observation))


class PeerEgo(OfferedSpeeds, IDMVehicle):
    """A car of highway-env's IDM and MOBIL as the ego.

    It has the attributes of an `MDPVehicle` that rewards read.

    Attributes:
        decisions: list to which the ego appends the duration of each of its decisions
            [s].
    """

    decisions: list[float]

    def act(self, action: dict | str | None = None) -> None:
        """Follow and change lanes; the action is ignored."""
        start = perf_counter()
        super().act(action)
        # In a frame, not when the environment passes on its action.
        if action is None:
            self.decisions.append(perf_counter() - start)


class CommuterEgo(PeerEgo, CommuterVehicle):
    """A `ms_highway.CommuterVehicle` as the ego."""


class Idm(Peer):
    """Let highway-env's IDM and MOBIL drive the ego, on a route to a goal.

    They decide in every frame. The desired speed is that of
    `ms_highway.road.stock.desired_speed_of`, as for this package's drivers; IDM obeys
    the speed limits of lanes by itself. A timed goal overrides the desired speed.

    Attributes:
        ego_type: class of the ego.
    """

    ego_type: ClassVar[type[PeerEgo]] = PeerEgo

    def begin(self) -> None:
        """Replace the ego by one that drives itself."""
        speed = desired_speed_of(self.env)
        ego: PeerEgo = replace_ego(
            self.env,
            lambda old: self.ego_type(
                old.road, old.position, old.heading, old.speed, target_speed=speed
            ),
        )
        action = self.inner.config["action"]
        speeds = action.get("target_speeds", MDPVehicle.DEFAULT_TARGET_SPEEDS)
        ego.target_speeds = np.array(speeds)
        ego.decisions = self.decisions
        goal = destination_of(self.inner)
        if isinstance(self.inner, ExitEnv):
            last = self.inner.config["lanes_count"]
            ego.route = [("0", "1", last - 1), ("1", "2", last), ("2", "exit", 0)]
        elif isinstance(goal, str):
            ego.plan_route_to(goal)
            # The first road may be driven on any lane.
            ego.route[0] = (*ego.lane_index[:2], None)

    def choose(self) -> object:
        """Let the ego decide, at the speed that reaches a timed goal in time."""
        goal = destination_of(self.inner)
        if isinstance(goal, TimedGoal):
            ego = self.inner.vehicle
            ego.target_speed = goal.desired_speed(ego, self.inner.time)
        return super().choose()


class Commuter(Idm):
    """Let a `ms_highway.CommuterVehicle` drive the ego, like `Idm`."""

    ego_type = CommuterEgo


class Human(Peer):
    """Drive like the recorded vehicle that the ego replaces, and then straight on.

    Raises:
        ValueError: from a reset, if the ego of a planning problem replaces no vehicle.
    """

    def begin(self) -> None:
        """Replace the ego by a vehicle that moves like the recorded one."""
        env = self.inner
        if not isinstance(env, RecordedEnv) or env.task.track is None:
            raise ValueError(
                "the driver human repeats the drive of a recorded vehicle; say --egos"
                " changing"
            )
        track = env.scenario.track(env.task.track)
        replace_ego(
            env, lambda old: ReplayedVehicle(old.road, old.road.recorded(track))
        )


# Starts in recordings


class RecordedStart(NamedTuple):
    """The start of an episode.

    Attributes:
        name: for logs and files.
        recording: a file, or the name of a recording of the package.
        ego: as in the environment's configuration: ``problem:NUMBER``, or the number of
            a recorded vehicle.
        replaced: number of the recorded vehicle whose place the ego takes, None for
            none.
    """

    name: str
    recording: str
    ego: str | int
    replaced: int | None = None

    @property
    def config(self) -> dict:
        """Its part of the environment's configuration."""
        return {"recording": self.recording, "ego": self.ego}


def starts_of(data: Path | None, egos: str) -> list[RecordedStart]:
    """Return the starts in a directory of recordings.

    Args:
        data: the directory; None for the recording of the package.
        egos: ``problem`` for all planning problems, ``changing`` for all vehicles that
            change lanes.

    Raises:
        ValueError: if there is no recording, no start in any, or a planning problem
            cannot be started.
    """
    recordings = (
        [SHIPPED_RECORDING] if data is None else [*map(str, scenario_files(data))]
    )
    starts: dict[tuple, RecordedStart] = {}
    for recording in recordings:
        scenario = open_recording(recording)
        if egos == "problem":
            for problem in scenario.problems:
                start = _start_of_problem(scenario, recording, problem.number)
                starts[recording, problem.number] = start
            continue
        for track in scenario.tracks:
            if _changes_lane(scenario, track):
                number = track.number
                name = f"{scenario.name}_{number}"
                start = RecordedStart(name, recording, number, replaced=number)
                # Files of the same group may share tracks.
                place = tuple(track.samples[0, 1:3].round(2))
                starts.setdefault((scenario.group, number, place), start)
    if not starts:
        what = "planning problem" if egos == "problem" else "vehicle that changes lanes"
        raise ValueError(
            f"--data: there is no {what} in {data or 'the recording of the package'};"
            " give another directory"
        )

    # Recordings may share an id: their files tell such starts apart.
    names = Counter(start.name for start in starts.values())
    distinct = []
    for start in starts.values():
        if names[start.name] > 1:
            file = Path(start.recording).name
            start = start._replace(name=f"{start.name}_{file}")
        distinct.append(start)
    return distinct


def _start_of_problem(
    scenario: TrafficRecording,
    recording: str,
    number: int,
) -> RecordedStart:
    """Return the start of a planning problem.

    Raises:
        ValueError: if it cannot be started.
    """
    alone = len(scenario.problems) == 1
    name = scenario.name if alone else f"{scenario.name}_{number}"
    ego = f"problem:{number}"
    try:
        replaced = problem_of(scenario, ego).track
    except ValueError as error:
        raise ValueError(f"{recording}: {error}") from error
    return RecordedStart(name, recording, ego, replaced)


def _changes_lane(scenario: TrafficRecording, track: RecordedTrack) -> bool:
    """Return whether the first and the last lane of a vehicle differ."""
    # The shortest track has 2.5 s, in steps of 0.1 s.
    least_steps = 25
    # In widths of a lane: at the end, the vehicle is near the middle of a lane ...
    largest_offset = 0.45
    # ... and has moved sideways.
    least_motion = 0.5

    samples = track.samples
    if not track.drives or samples[-1, 0] - samples[0, 0] < least_steps:
        return False
    road = straight_road(scenario)
    begin, end = road.states_of_track(track)[[0, -1], 1] / road.lane_width
    in_lane = abs(end - round(end)) < largest_offset
    moved = abs(end - begin) > least_motion
    return round(begin) != round(end) and in_lane and moved
