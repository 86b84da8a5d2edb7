"""Drive by the commonroad-reactive-planner, which samples trajectories along a reference path."""

import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np

from ms_highway.benchmarks.road.peers import Peer
from ms_highway.benchmarks.road.recorded import GuidedVehicle
from ms_highway.envs.recorded.commonroad import open_commonroad
from ms_highway.envs.recorded.environment import RecordedEnv
from ms_highway.envs.recorded.scenario import SHIPPED
from ms_highway.envs.road.stock import replace_ego
from ms_highway.game.scenario import TIME_STEP
from ms_highway.runtime.extras import needing

EVERY = 3  # steps from one plan to the next, the planner's own default
BEFORE, AFTER, SPACING = 15.0, 100.0, 0.125  # m, that are added to the reference path, and between points there
SOONEST = 5  # steps, until the ego wants to be at its goal
FASTEST = 35.0  # m/s, that is desired
SOON = 2.0  # s before the goal, from which the desired speed is one that it allows
WITHIN = 0.3  # m/s, inside the interval of speeds there


class Reactive(Peer):
    """Drive by the commonroad-reactive-planner, which knows where all others were recorded to go: *privileged*.

    It believes so even where they react to the ego. It plans every three steps, from where the ego is, and the ego
    follows the plan exactly; without a new one it keeps to the last, and at its end to its speed and heading. This is
    the tuned planner: a horizon of 3 s, its mode for low speeds below 2 m/s, and a desired speed by the way and time
    that are left. A decision is a call of the planner's ``plan``.

    Attributes:
        failures: how often in this episode there was ``"no plan"``, or an ``"error"`` of the planner.

    Raises:
        ValueError: from a reset, for other tasks than the planning problem of a CommonRoad file.
        ImportError: from a reset, without the packages of the extra ``judge``.
    """

    counted = slice(-1)  # of the decisions of a step: the last is all of `choose`
    tuned: ClassVar[bool] = True

    def begin(self, seed: int | None) -> None:
        """Prepare the planner, and put a car that goes where it plans in the place of the ego."""
        inner = self.inner
        if not isinstance(inner, RecordedEnv) or inner.task.track is not None or inner.config["recording"] == SHIPPED:
            raise ValueError(
                "the reactive planner solves planning problems of CommonRoad files only; give one as "
                "config['recording'] of ms-highway/recorded-v0, and config['ego'] = 'problem'"
            )
        with needing("judge"):
            from commonroad_rp.state import ReactivePlannerState
        scenario, problems = open_commonroad(Path(inner.config["recording"]))
        problem = problems.planning_problem_dict[inner.task.problem.number]
        start = problem.initial_state
        start.acceleration = start.acceleration or 0.0
        self._ego = replace_ego(self.env, lambda old: GuidedVehicle(old.road, old.position, old.heading, old.speed))
        self._configuration = _configured(scenario, problem, self.tuned)
        car = self._configuration.vehicle
        self._state = ReactivePlannerState.create_from_initial_state(copy(start), car.wheelbase, car.wb_rear_axle)
        self._along_path: Any = None  # the state along the reference path, None where only the planner can tell
        self._planned: Iterator[Any] = iter(())
        self._planner: Any = None
        self.failures: Counter[str] = Counter()
        with self._surviving():
            self._planner = _prepared(self._configuration)

    def step(self, action: Any = None) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step; the planner goes with the episode, as it complains of what is left when the process ends."""
        *outcome, terminated, truncated, info = super().step(action)
        if terminated or truncated:
            self._planner = None
        return *outcome, terminated, truncated, info

    def choose(self) -> Any:
        """Plan, if it is time to, and tell the ego where to go in this step."""
        if self.inner.steps % EVERY == 0:
            begun = perf_counter()
            with self._surviving():
                planner = self._planner
                planner.reset(None, self._state, self._along_path, planner.collision_checker, planner.coordinate_system)
                planner.set_desired_velocity(self._desired_speed(), self._state.velocity)
                begun = perf_counter()
                plan = planner.plan()
                if plan is None:
                    self.failures["no plan"] += 1
                else:
                    trajectory, *along_path = plan
                    self._planned = zip(trajectory.state_list, zip(*along_path, strict=True), strict=True)
                    next(self._planned)  # where it is
            self.decisions.append(perf_counter() - begun)
        self._state, self._along_path = next(self._planned, None) or (_onward(self._state), None)
        centre = self._state.shift_state_to_center(self._state, self._configuration.vehicle.wb_rear_axle)
        axes = self.inner.axes
        self._ego.coming = axes.positions(centre.position), axes.headings(centre.orientation), centre.velocity
        return super().choose()

    @contextmanager
    def _surviving(self) -> Iterator[None]:
        """Count an error of the planner, of any kind, and go on; its warnings are nobody's concern."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                yield
            except ImportError:
                raise
            except Exception:
                self.failures["error"] += 1

    def _desired_speed(self) -> float | None:
        """Return the mean speed to the goal that is closest to what the ego has and the goal allows [m/s].

        None, for the planner's own, if the goal has no place.
        """
        appointment, planner, now = self.inner.appointment, self._planner, self._state.velocity
        if not self.tuned or appointment is None:
            return None
        goal = self.inner.axes.points(appointment.position)
        there, here = (
            planner.coordinate_system.convert_to_curvilinear_coords(*point)[0] for point in (goal, self._state.position)
        )
        (first, last), (slowest, fastest), steps = appointment.times, appointment.speeds, self.inner.steps
        first = max(first, (steps + SOONEST) * TIME_STEP)
        left = np.arange(first, max(first, last) + 1e-9, TIME_STEP) - steps * TIME_STEP
        means = (there - here - planner.vehicle_params.wb_rear_axle) / left
        wanted = (slowest + fastest) / 2 if np.isfinite(fastest) else now
        best = int(np.argmin(np.abs(means - (now + wanted) / 2)))
        speed = float(np.clip(means[best], 0.0, FASTEST))
        if np.isfinite(fastest) and left[best] < SOON:
            speed = float(np.clip(speed, slowest + WITHIN, fastest - WITHIN))
        return speed


class ReactiveDefault(Reactive):
    """Drive by the same planner as its published example does: its default settings, and its own desired speed."""

    tuned = False


def _configured(scenario: Any, problem: Any, tuned: bool) -> Any:
    """Return the configuration of a planner."""
    from commonroad_rp.utility.config import DebugConfiguration, PlanningConfiguration, ReactivePlannerConfiguration

    settings = {"time_steps_computation": 30, "low_vel_mode_threshold": 2.0} if tuned else {}
    configuration = ReactivePlannerConfiguration(
        planning=PlanningConfiguration(replanning_frequency=EVERY, **settings),
        debug=DebugConfiguration(multiproc=False, logging_level="ERROR"),
    )
    configuration.update(scenario, problem)
    return configuration


def _prepared(configuration: Any) -> Any:
    """Return a planner along the shortest path to the goal, which goes straight on beyond its ends."""
    from commonroad_rp.reactive_planner import ReactivePlanner
    from commonroad_rp.utility.utils_coordinate_system import create_coordinate_system, create_initial_ref_path

    problem = configuration.planning_problem
    path = np.asarray(create_initial_ref_path(configuration.scenario.lanelet_network, problem))
    path = _extended(_extended(path, AFTER)[::-1], BEFORE)[::-1]  # as start and goal may lie close to its ends
    planner = ReactivePlanner(configuration)
    planner.set_reference_path(coordinate_system=create_coordinate_system(path))
    return planner


def _extended(path: np.ndarray, length: float) -> np.ndarray:
    """Return a path that goes straight on beyond its end for a length [m]."""
    direction = path[-1] - path[max(-6, -len(path))]
    direction = direction / np.linalg.norm(direction)
    return np.vstack([path, path[-1] + direction * SPACING * np.arange(1, round(length / SPACING) + 1)[:, None]])


def _onward(state: Any) -> Any:
    """Return a planner's state a step later at the same speed and heading."""
    direction = np.array([np.cos(state.orientation), np.sin(state.orientation)])
    position = state.position + direction * state.velocity * TIME_STEP
    still = {"acceleration": 0.0, "yaw_rate": 0.0, "steering_angle": 0.0}
    return replace(state, time_step=state.time_step + 1, position=position, **still)
