"""Make drivers from outside this package (highway-env's, trained agents, recorded
humans), and choose recorded starts.

Starts in recordings are planning problems, or vehicles that change lanes.
"""

from collections import Counter
from copy import deepcopy
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from highway_env.envs import ExitEnv
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
        seen: the last observation.
        decisions: durations of decisions in this step that the ego itself makes in its
            frames [s].
    """

    seen: Any

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.inner: Any = env.unwrapped
        self.decisions: list[float] = []

    def reset(self, **options: Any) -> tuple[Any, dict]:
        """Start an episode."""
        self.seen, info = super().reset(**options)
        self.begin()
        return self.seen, info

    def step(self, action: Any = None) -> tuple[Any, Any, bool, bool, dict]:
        """Decide, and take a step of the environment."""
        self.decisions.clear()
        start = perf_counter()
        chosen = self.choose()
        seconds = perf_counter() - start
        self.seen, *outcome, info = super().step(chosen)
        return (
            self.seen,
            *outcome,
            info | {"road": {"decisions": [*self.decisions] or [seconds]}},
        )

    def begin(self) -> None:
        """Prepare an episode after its reset."""

    def choose(self) -> Any:
        """Return the action of the coming step, by default a placeholder for an ego
        that drives itself.
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

    def choose(self) -> Any:
        """Return the agent's action for the last observation."""
        return self.policy(deepcopy(self.seen))  # which others hold, too


class PeerEgo(OfferedSpeeds, IDMVehicle):
    """A car of highway-env's IDM and MOBIL as the ego, with the attributes of an
    `MDPVehicle` that rewards read.

    Attributes:
        decisions: list to which the ego appends the duration of each of its decisions
            [s].
    """

    decisions: list[float]

    def act(self, action: dict | str | None = None) -> None:
        """Follow and change lanes; the action is ignored."""
        start = perf_counter()
        super().act(action)
        if action is None:  # in a frame, not when the environment passes on its action
            self.decisions.append(perf_counter() - start)


class CommuterEgo(PeerEgo, CommuterVehicle):
    """A `ms_highway.CommuterVehicle` as the ego."""


class Idm(Peer):
    """Let highway-env's IDM and MOBIL drive the ego, on a route to the goal if there is
    one.

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
        ego: Any = replace_ego(
            self.env,
            lambda old: self.ego_type(
                old.road, old.position, old.heading, old.speed, target_speed=speed
            ),
        )
        ego.target_speeds = np.array(
            self.inner.config["action"].get(
                "target_speeds", MDPVehicle.DEFAULT_TARGET_SPEEDS
            )
        )
        ego.decisions = self.decisions
        goal = destination_of(self.inner)
        if isinstance(self.inner, ExitEnv):
            last = self.inner.config["lanes_count"]
            ego.route = [("0", "1", last - 1), ("1", "2", last), ("2", "exit", 0)]
        elif isinstance(goal, str):
            ego.plan_route_to(goal)
            ego.route[0] = (*ego.lane_index[:2], None)  # on any lane

    def choose(self) -> Any:
        """Let the ego decide; with a timed goal, set the speed that reaches it in time."""
        goal = destination_of(self.inner)
        if isinstance(goal, TimedGoal):
            self.inner.vehicle.target_speed = goal.desired_speed(
                self.inner.vehicle, self.inner.time
            )
        return super().choose()


class Commuter(Idm):
    """Let a `ms_highway.CommuterVehicle` drive the ego, as `Idm` does with
    highway-env's.
    """

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
        track: Any = env.scenario.track(env.task.track)
        replace_ego(
            env, lambda old: ReplayedVehicle(old.road, old.road.recorded(track))
        )


# Starts in recordings

LONG_ENOUGH = 2.5  # s, shortest track of a vehicle
CENTRED, CHANGED = (
    0.45,
    0.5,
)  # widths of a lane: largest final offset from its middle, and smallest lateral motion


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
    """Return the starts in a directory of recordings, by default in that of the
    package.

    Args:
        data: the directory.
        egos: ``problem`` for all planning problems, ``changing`` for all vehicles that
            change lanes.

    Raises:
        ValueError: if there is no recording, no start in any, or a planning problem
            cannot be started.
    """
    starts: dict[tuple, RecordedStart] = {}
    for recording in (
        [SHIPPED_RECORDING] if data is None else map(str, scenario_files(data))
    ):
        scenario = open_recording(recording)
        if egos == "changing":
            for track in filter(partial(_changes_lane, scenario), scenario.tracks):
                place = tuple(
                    track.samples[0, 1:3].round(2)
                )  # files of the same group may share tracks
                start = RecordedStart(
                    f"{scenario.name}_{track.number}",
                    recording,
                    track.number,
                    track.number,
                )
                starts.setdefault((scenario.group, track.number, place), start)
            continue
        for problem in scenario.problems:
            name = (
                scenario.name
                if len(scenario.problems) == 1
                else f"{scenario.name}_{problem.number}"
            )
            ego = f"problem:{problem.number}"
            try:
                replaced = problem_of(scenario, ego).track
            except ValueError as error:
                raise ValueError(f"{recording}: {error}") from error
            starts[recording, problem.number] = RecordedStart(
                name, recording, ego, replaced
            )
    if not starts:
        what = "planning problem" if egos == "problem" else "vehicle that changes lanes"
        raise ValueError(
            f"--data: there is no {what} in {data or 'the recording of the package'};"
            " give another directory"
        )

    # Recordings may share an id: their files tell such starts apart.
    names = Counter(start.name for start in starts.values())
    return [
        (
            start
            if names[start.name] == 1
            else start._replace(name=f"{start.name}_{Path(start.recording).name}")
        )
        for start in starts.values()
    ]


def _changes_lane(scenario: TrafficRecording, track: RecordedTrack) -> bool:
    """Return whether the first and the last lane of a vehicle differ."""
    samples = track.samples
    if not track.drives or samples[-1, 0] - samples[0, 0] < 10 * LONG_ENOUGH:
        return False
    road = straight_road(scenario)
    begin, end = road.states_of_track(track)[[0, -1], 1] / road.lane_width
    return (
        round(begin) != round(end)
        and abs(end - round(end)) < CENTRED
        and abs(end - begin) > CHANGED
    )
