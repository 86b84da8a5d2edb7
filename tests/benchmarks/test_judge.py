"""An outside judge of drives in a scenario of US-101, and an outside planner that solves it."""

import gzip
import re
import sys

import gymnasium as gym
import numpy as np
import pytest

from ms_highway.benchmarks.road.judge import Verdict, judge_drive
from ms_highway.benchmarks.road.reactive import Reactive, ReactiveDefault
from ms_highway.envs.recorded.commonroad import open_commonroad

pytest.importorskip("commonroad_dc")
pytest.importorskip("commonroad_rp")

pytestmark = pytest.mark.filterwarnings("ignore:Call to deprecated create function:DeprecationWarning")  # of protobuf

STEPS = 66  # until the last time of the goal
REACHED = 58  # step at which the goal is reached at the speed of the start


@pytest.fixture(scope="session")
def problem_file(us101_directory):
    """A scenario whose planning problem is solved by keeping speed and heading."""
    return us101_directory / "USA_US101-14_1_T-1.xml.gz"


@pytest.fixture(scope="session")
def world(problem_file):
    return open_commonroad(problem_file)


@pytest.fixture(scope="session")
def problem(world):
    (problem,) = world[1].planning_problem_dict.values()
    return problem


def driven(problem, acceleration=0.0, turning=0.0, steps=STEPS):
    """Step, x, y, orientation and speed of a drive from the start [m/s^2, rad/s]."""
    start, times = problem.initial_state, 0.1 * np.arange(steps + 1)
    headings, speeds = start.orientation + turning * times, start.velocity + acceleration * times
    moved = 0.05 * (speeds[1:] + speeds[:-1])[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=-1)[:-1]
    places = start.position + np.vstack([np.zeros(2), np.cumsum(moved, axis=0)])
    return np.column_stack([np.arange(steps + 1), places, headings, speeds])


@pytest.fixture
def judged(problem_file, world, problem, tmp_path):
    """A function that writes a drive as a CommonRoad solution and returns the verdict."""
    from commonroad.common.solution import (
        CommonRoadSolutionWriter,
        CostFunction,
        PlanningProblemSolution,
        Solution,
        VehicleModel,
        VehicleType,
    )
    from commonroad.scenario.state import KSState
    from commonroad.scenario.trajectory import Trajectory

    def verdict(rows, number=problem.planning_problem_id):
        states = [
            KSState(int(step), np.array(place), velocity=speed, orientation=orientation, steering_angle=0.0)
            for step, *place, orientation, speed in rows.tolist()
        ]
        drive = PlanningProblemSolution(
            number, VehicleModel.KS, VehicleType.BMW_320i, CostFunction.JB1, Trajectory(states[0].time_step, states)
        )
        writer = CommonRoadSolutionWriter(Solution(world[0].scenario_id, [drive]))
        writer.write_to_file(str(tmp_path), "drive.xml", overwrite=True)
        return judge_drive(problem_file, tmp_path / "drive.xml")

    return verdict


GOOD = Verdict(reached=True, collision=False, off_road=False, feasible=True)


def test_who_keeps_speed_and_heading_reaches_the_goal(judged, problem):
    assert judged(driven(problem)) == GOOD


def test_who_is_too_slow_is_hit_from_behind(judged, problem):
    assert judged(driven(problem, acceleration=-1.0)) == Verdict(False, collision=True, off_road=False, feasible=True)


def test_who_turns_leaves_the_road(judged, problem):
    verdict = judged(driven(problem, turning=0.2, steps=30))
    assert verdict.off_road
    assert not verdict.reached


def test_nobody_can_jump_or_begin_elsewhere(judged, problem):
    rows = driven(problem, steps=20)
    jump = rows + np.where(np.arange(21) < 10, 0.0, 0.5)[:, None] * [0, 1, 1, 0, 0]
    elsewhere = rows + np.array([0, 0.2, 0, 0, 0])
    assert [judged(each).feasible for each in (rows, jump, elsewhere)] == [True, False, False]


def test_what_comes_after_the_goal_does_not_matter(judged, problem, world):
    rows = driven(problem)
    others = (other.state_at_time(REACHED + 1) for other in world[0].dynamic_obstacles)
    rows[REACHED + 1 :, 1:3] = next(other.position for other in others if other)
    assert judged(rows) == GOOD
    rows[REACHED:, 4] = 30.0  # too fast for the goal
    assert judged(rows) == Verdict(reached=False, collision=True, off_road=False, feasible=False)


def test_solutions_that_cannot_be_judged_are_refused_by_name(judged, problem, problem_file, tmp_path):
    rows = driven(problem, steps=5)
    for changed, message in (
        (rows + np.array([0, np.nan, 0, 0, 0]), "nowhere on Earth"),
        (rows * [2, 1, 1, 1, 1], "do not follow each other"),
    ):
        with pytest.raises(ValueError, match=rf"drive\.xml cannot be read .*{message}.*; export the drive again"):
            judged(changed)
    with pytest.raises(ValueError, match=r"drive\.xml cannot be read .*no planning problem 7"):
        judged(rows, number=7)
    judged(rows)
    whole = (tmp_path / "drive.xml").read_text()
    for text in (whole[:-200], whole.replace("KS2:", "PM2:"), whole.replace("KS2:JB1:", ""), "<html/>"):
        (tmp_path / "drive.xml").write_text(text)
        with pytest.raises(ValueError, match=r"drive\.xml cannot be read as a CommonRoad solution"):
            judge_drive(problem_file, tmp_path / "drive.xml")
    with pytest.raises(ValueError, match=r"missing\.xml cannot be read as a CommonRoad solution"):
        judge_drive(problem_file, tmp_path / "missing.xml")
    with pytest.raises(ValueError, match=r"missing\.xml cannot be read as a CommonRoad scenario"):
        judge_drive(tmp_path / "missing.xml", tmp_path / "drive.xml")


def test_the_extra_is_named_where_it_is_missing(problem_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "shapely", None)
    with pytest.raises(ImportError, match=re.escape("pip install 'ms-highway[judge]'")):
        judge_drive(problem_file, problem_file)


def outcome(kind, recording, **config):
    env = kind(gym.make("ms-highway/recorded-v0", config={"recording": str(recording), "traffic": "replay"} | config))
    env.reset(seed=0)
    done, decisions = False, []
    while not done:
        *_, terminated, truncated, info = env.step()
        done, decisions = terminated or truncated, decisions + info["road"]["decisions"]
    return env, info["recorded"], decisions


@pytest.mark.slow
def test_the_tuned_planner_reaches_the_goal(problem_file):
    env, told, decisions = outcome(Reactive, problem_file)
    assert told["success"]
    assert told["step"] == 56
    assert len(decisions) == 19
    assert not env.failures.total()


def test_who_cannot_plan_keeps_speed_and_heading(problem_file, problem, tmp_path):
    """The goal is far from all lanelets, so that there is no way to it."""
    with gzip.open(problem_file, "rt") as packed:
        (tmp_path / "astray.xml").write_text(re.sub("<x>66.7131</x>", "<x>566.7131</x>", packed.read()))
    env, told, decisions = outcome(Reactive, tmp_path / "astray.xml")
    assert env.failures == {"error": len(decisions)}
    ego, (step, *place, orientation, speed) = env.unwrapped.vehicle, driven(problem)[-1]
    assert told["step"] == step
    np.testing.assert_allclose(env.unwrapped.axes.points(ego.position), place, atol=1e-6)
    np.testing.assert_allclose(env.unwrapped.axes.orientations(ego.heading), orientation)
    assert ego.speed == speed


def test_other_tasks_are_refused(problem_file):
    for kind, recording, config in (
        (Reactive, "us101", {}),
        (ReactiveDefault, problem_file, {"ego": 47}),
    ):
        with pytest.raises(ValueError, match="the reactive planner solves planning problems of CommonRoad files only"):
            outcome(kind, recording, **config)
