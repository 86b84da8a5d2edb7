"""Drivers in stock scenes and recordings: figures, faults, exports, the command."""

import json

import gymnasium as gym
import numpy as np
import pytest
import recordings
from commands import run
from commonroad.common.reader.file_reader_xml import XMLFileReader
from commonroad.common.solution import CommonRoadSolutionReader
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.benchmarks.road import RECORDED
from ms_highway.benchmarks.road.episodes import Block, run_episode, summary
from ms_highway.benchmarks.road.export import BMW_320I
from ms_highway.benchmarks.road.measures import Watch, motion_figures
from ms_highway.benchmarks.road.peers import Peer, starts_of

KEYS = {
    "success",
    "collisions",
    "at_fault",
    "reward_per_step",
    "max_acceleration",
    "p50_ms",
    "p99_ms",
}


@pytest.mark.parametrize(
    ("action", "place", "speed", "at_fault"),
    [
        # It is rear-ended while it keeps its lane.
        ("IDLE", [75.0, 4.0], 35.0, False),
        # It cuts in ahead of a faster car.
        ("LANE_RIGHT", [86.0, 8.0], 32.0, True),
        # It runs into the car ahead.
        ("IDLE", [120.0, 4.0], 5.0, True),
    ],
)
def test_an_ego_is_at_fault_unless_rear_ended_there(action, place, speed, at_fault):
    """An ego in the middle lane of an empty highway collides with another car."""
    config = {"vehicles_count": 0, "simulation_frequency": 15}
    env = gym.make("highway-fast-v0", config=config).unwrapped
    env.reset(seed=0)
    ego = MDPVehicle(
        env.road, [100.0, 4.0], 0.0, 20.0, target_speed=20.0, target_speeds=[0, 20, 35]
    )
    env.road.vehicles = [ego, Vehicle(env.road, place, 0.0, speed)]
    env.controlled_vehicles = [ego]
    watch = Watch(env)
    for each in [action, "IDLE", "IDLE"]:
        env.step(env.action_type.actions_indexes[each])
    assert (watch.crashed, watch.at_fault) == (True, at_fault)


def test_acceleration_and_jerk_on_a_circle_are_those_of_turning():
    angle = 0.5 * np.arange(50) / 15
    radius = 20.0
    speed = 10.0
    states = np.stack(
        [radius * np.sin(angle), -radius * np.cos(angle), angle, np.full(50, speed)],
        axis=-1,
    )
    motion = motion_figures(states, 1 / 15)
    acceleration = speed**2 / radius
    of_centre = motion["max_acceleration_of_centre"]
    jerk = np.sqrt(motion["squared_jerk"])
    assert motion["max_acceleration"] == pytest.approx(acceleration, rel=1e-6)
    assert of_centre == pytest.approx(acceleration, rel=1e-3)
    assert jerk == pytest.approx(speed**3 / radius**2, rel=1e-3)


def test_idm_reaches_goals_without_a_crash():
    block = Block("merge-v0", "idm")
    idm = summary(block, [run_episode(block, seed) for seed in range(2)])
    assert idm.keys() >= KEYS
    assert (idm["success"], idm["collisions"]) == (1, 0)
    # MOBIL's lane changes exceed the grip of tyres.
    assert idm["label"] == "unphysical"
    assert 0 < idm["p50_ms"] <= idm["p99_ms"]


def test_an_episode_that_ends_off_the_road_is_no_success():
    class Straight(Peer):
        def choose(self):
            return self.inner.action_space.high * [0]

    block = Block("racetrack-v1", "straight")
    env = Straight(gym.make("racetrack-v1", config={"other_vehicles": 0}))
    episode = run_episode(block, 0, env)
    assert episode["crashed"] is False
    assert episode["off_road"] is True
    assert episode["success"] is False


@pytest.mark.slow
def test_the_command_writes_figures_episodes_and_films_of_every_driver(
    tmp_path, capsys
):
    file = tmp_path / "road.json"
    log = tmp_path / "road.csv"
    command = (
        "bench road merge-v0 --drivers idm fixed:naive --seeds 2 --seed 5 --json"
        f" {file} --log {log}"
    )
    run(f"{command} --films {tmp_path}")
    results = json.loads(file.read_text())["merge-v0"]
    assert list(results) == ["idm", "fixed:naive"]
    assert results["idm"]["seeds"] == [5, 2]
    assert len(log.read_text().splitlines()) == 1 + 2 * 2
    printed = " ".join(capsys.readouterr().out.split())
    assert "merge-v0, traffic idm: 2 episodes" in printed
    assert "100 % (43, 100)" in printed
    assert (tmp_path / "merge-v0_idm_success_5.gif").is_file()


def test_a_drive_is_exported_as_a_scenario_and_a_solution(tmp_path):
    """In the scenario, others move as they did in the episode.

    The solution is the drive of a kinematic single-track model. Another car's centre is
    not that of its states.
    """
    shifted = recordings.RECTANGLE.replace(
        "</rec", "<originXShift>-1.5</originXShift></rec"
    )
    cars = recordings.car(100, 60, 0) + recordings.car(101, 40, 3.5, shape=shifted)
    (tmp_path / "small.xml").write_text(
        recordings.scenario(cars=cars, problems=recordings.problem(right=0.3))
    )

    (start,) = starts_of(tmp_path, "problem")
    episode = run_episode(Block(RECORDED, "idm", "idm", (start,), tmp_path), 0)
    file = tmp_path / "idm" / "idm" / start.name
    last = episode["steps"]

    scenario, problems = XMLFileReader(f"{file}.xml").open()
    assert list(problems.planning_problem_dict) == [7]
    assert len(scenario.lanelet_network.lanelets) == 4
    ahead = scenario.obstacle_by_id(100)
    first = ahead.state_at_time(0).position
    np.testing.assert_allclose(first, recordings.place(60, 0), atol=1e-6)
    assert ahead.state_at_time(last) is not None
    assert ahead.state_at_time(last + 1) is None

    solutions = CommonRoadSolutionReader.open(f"{file}.solution.xml")
    (solution,) = solutions.planning_problem_solutions
    assert (solution.planning_problem_id, solution.vehicle_id) == (7, "KS2")
    states = solution.trajectory.state_list
    assert [state.time_step for state in states] == list(range(last + 1))
    np.testing.assert_allclose(states[0].position, recordings.place(20, 0.3), atol=1e-6)
    distance = np.hypot(*(states[-1].position - states[0].position))
    assert distance == pytest.approx(episode["distance"], rel=0.02)

    # Steering angles turn the vehicle as it was turned.
    yaw_rates = []
    for state in states[:-1]:
        curvature = np.tan(state.steering_angle) / BMW_320I.wheelbase
        yaw_rates.append(state.velocity * curvature)
    turned = np.diff([state.orientation for state in states])
    np.testing.assert_allclose(turned, 0.1 * np.array(yaw_rates), atol=1e-6)
    assert max(map(abs, yaw_rates)) > 1e-3


def test_exports_stay_in_their_directory_whatever_the_ids(tmp_path):
    """Ids of recordings are paths, and the same."""
    data = tmp_path / "data"
    exports = tmp_path / "a" / "b" / "exports"
    data.mkdir()
    text = recordings.scenario(problems=recordings.problem(goal=22.0, times=(0, 20)))
    hostile = text.replace("USA_Test-1_1_T-1", "../../../../x")
    for name in ("one", "two"):
        (data / f"{name}.xml").write_text(hostile)
    starts = tuple(starts_of(data, "problem"))
    assert [start.name for start in starts] == [
        "../../../../x_one.xml",
        "../../../../x_two.xml",
    ]
    for seed in range(2):
        with pytest.warns(UserWarning, match="Not a valid scenario ID"):
            run_episode(Block(RECORDED, "idm", "replay", starts, exports), seed)
    written = [path for path in tmp_path.rglob("*.xml") if path.parent != data]
    assert {path.parent for path in written} == {exports / "replay" / "idm"}
    assert len(written) == 2 * 2


@pytest.mark.slow
def test_the_command_says_whose_place_the_ego_takes(tmp_path, capsys):
    cars = recordings.car(100, 20, 0) + recordings.car(101, 40, 3.5)
    problem = recordings.problem(goal=22.0, times=(0, 20))
    text = recordings.scenario(cars=cars, problems=problem)
    (tmp_path / "small.xml").write_text(text)
    run(f"bench road recorded --data {tmp_path} --drivers idm --traffic replay")
    place = "the ego takes the place of the recorded vehicle 100 in USA_Test-1_1_T-1"
    assert place in capsys.readouterr().err
