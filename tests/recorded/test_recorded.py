"""Recorded traffic: of US-101, and of small scenarios written by hand, as an
environment.
"""

from io import BytesIO
from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from recordings import (
    RECTANGLE,
    TURN,
    bend,
    car,
    lanelet,
    moving,
    place,
    problem,
    scenario,
    standing,
    two_lanes,
)

from ms_highway import drive
from ms_highway.benchmarks.road.peers import starts_of
from ms_highway.geometry.road_map import road_map
from ms_highway.recorded.commonroad import read_xml
from ms_highway.recorded.opening import SHIPPED_RECORDING, open_recording
from ms_highway.recorded.planning_problem import problem_of
from ms_highway.recorded.straight_road import straight_road
from ms_highway.recorded.traffic import overlap

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

CARS = car(100, 60, 0) + car(101, 40, 3.5)
PROBLEM = problem()
WIDTH = 3.5  # m, of the lanes written by hand
SEAM = 0.1  # m, beyond the edges of the road that still counts as road


def written(directory, cars=CARS, problems=PROBLEM, lanelets=""):
    """The file of a small scenario, by default with two lanes, two cars, a problem."""
    path = directory / "small.xml"
    path.write_text(scenario(lanelets=lanelets, cars=cars, problems=problems))
    return str(path)


def idle(*_):
    """A continuous action, a new array each time, as `info` holds it."""
    return np.zeros(2)


def begun(file, traffic="replay", ego="problem"):
    """The environment of a file in its first episode, and what `reset` tells of it."""
    config = {
        "recording": str(file),
        "traffic": traffic,
        "ego": ego,
        "action": {"type": "ContinuousAction"},
    }
    env = gym.make(
        "ms-highway/recorded-v0", render_mode="rgb_array", config=config
    ).unwrapped
    return env, env.reset(seed=0)[1]["recorded"]


def steps(env, act=idle):
    """Drive an episode; yields what each step returns."""
    done = False
    while not done:
        outcome = env.step(act(env))
        yield outcome
        _, _, terminated, truncated, _ = outcome
        done = terminated or truncated


def braking(env):
    """Brake by 3 m/s^2 until the ego stands, along its lane."""
    ego = env.vehicle
    along, right = ego.lane.local_coordinates(ego.position)
    turned = np.sin(ego.heading - ego.lane.heading_at(along))
    braking = min(3.0, ego.speed / 0.1)
    return np.array([-braking / 5, np.clip(-0.2 * right - 4 * turned, -1, 1)])


def others(env):
    """The vehicles that traffic moves, by their number."""
    return {vehicle.track.number: vehicle for vehicle in env.road.others}


def state(env, vehicle):
    """Position and orientation in the map, and speed, of a vehicle."""
    return (
        *env.axes.points(vehicle.position),
        float(env.axes.headings(vehicle.heading)),
        vehicle.speed,
    )


@pytest.fixture(scope="module")
def us(us101_directory):
    """A function from the short name of a US-101 scenario to its file."""
    return lambda name: us101_directory / f"USA_US101-{name}_T-1.xml.gz"


def test_gymnasiums_checker_passes_without_a_warning(tmp_path):
    env, _ = begun(written(tmp_path))
    check_env(env)


def test_replayed_vehicles_are_where_they_were_recorded_at_each_step():
    env, told = begun(SHIPPED_RECORDING)
    tracks = {track.number: track for track in env.scenario.tracks}
    for step in range(env.task.last + 1):
        rows = {
            number: row
            for number, track in tracks.items()
            for row in track.samples
            if row[0] == step
        }
        assert told["step"] == step
        assert others(env).keys() == rows.keys()
        for number, vehicle in others(env).items():
            x, y, orientation, speed = state(env, vehicle)
            np.testing.assert_allclose(
                [x, y, speed], rows[number][[1, 2, 4]], rtol=0, atol=1e-6
            )
            assert abs(np.exp(1j * orientation) - np.exp(1j * rows[number][3])) < 1e-9
            assert tracks[number].size == (vehicle.LENGTH, vehicle.WIDTH)
        told = env.step(idle())[-1]["recorded"]
    assert len(rows) < len(tracks) > 30


@pytest.mark.parametrize("traffic", ["replay", "learned"])
def test_only_learned_vehicles_brake_for_a_standing_ego(traffic):
    env, _ = begun(SHIPPED_RECORDING, traffic)
    *_, (*_, info) = steps(env, braking)
    told = info["recorded"]
    assert told["collision"] == (traffic == "replay")
    if traffic == "learned":
        assert told["step"] == env.task.last
        ego, *traffic_now = [
            (*env.vehicle.lane.local_coordinates(vehicle.position), vehicle.speed)
            for vehicle in env.road.vehicles
        ]
        behind = [
            (x, speed) for x, y, speed in traffic_now if abs(y) < 1.5 and x < ego[0]
        ]
        _, speed_of_nearest = max(behind)
        assert speed_of_nearest < 3.0


@pytest.mark.parametrize("traffic", ["learned", "idm"])
def test_drivers_brake_for_a_standing_object_in_their_lane(traffic, tmp_path):
    states = [(step, *place(95, 0), TURN, 0.0) for step in range(61)]
    pillar = moving(102, states, "pillar")
    far_goal = problem(goal=190, times=(0, 60), speed=0.0)
    env, _ = begun(written(tmp_path, CARS + pillar, far_goal), traffic)
    *_, (*_, info) = steps(env)
    assert info["recorded"]["step"] == 60
    assert not any(
        overlap(one, other) for one, other in combinations(env.road.others, 2)
    )
    assert others(env)[100].speed < 6.0


def test_a_car_waits_while_its_place_is_taken(tmp_path):
    late = car(102, 20, 0, samples=60, first=5)
    far_goal = problem(speed=0.0, goal=190, times=(0, 60))
    env, told = begun(written(tmp_path, CARS + late, far_goal), "learned")
    assert told["waiting"].tolist() == [False, False, False]

    def start_late(env):
        return np.array([0.0 if env.steps < 12 else 1.0, 0.0])

    for *_, info in steps(env, start_late):
        told = info["recorded"]
        gap = env.vehicle.position[0] - env.axes.positions(place(20, 0))[0]
        if 102 in others(env):
            break
        assert told["waiting"].tolist() == [False, False, told["step"] >= 5]
    assert told["step"] > 12
    assert gap > 4.5
    assert not told["waiting"].any()
    np.testing.assert_allclose(
        env.axes.points(others(env)[102].position), place(20, 0), atol=0.1
    )


def test_a_goal_is_reached_where_commonroad_says_so(us):
    from commonroad.common.reader.file_reader_xml import XMLFileReader
    from commonroad.scenario.state import CustomState

    _, problems = XMLFileReader(BytesIO(read_xml(us("29_1")))).open()
    (theirs,) = problems.planning_problem_dict.values()
    task = problem_of(open_recording(str(us("29_1"))), "problem")
    (goal,) = task.goals

    # Samples around the goal, some of them outside: x, y, orientation, speed and step.
    centre = goal.area.mean(axis=0)
    middle = [*centre, np.mean(goal.headings), np.mean(goal.speeds), 43.0]
    reach = [2.0, 2.0, np.ptp(goal.headings) / 2, np.ptp(goal.speeds) / 2, 6.0]
    shares = np.random.default_rng(0).uniform(-1.1, 1.1, (400, 5))
    found = []
    for x, y, orientation, speed, step in middle + shares * reach:
        state = CustomState(
            position=np.array([x, y]),
            orientation=orientation,
            velocity=speed,
            time_step=round(step),
        )
        found.append(bool(theirs.goal.is_reached(state)))
        assert task.is_reached(round(step), (x, y), orientation, speed) == found[-1]
    assert 30 < sum(found) < 370


@pytest.mark.parametrize(
    ("cars", "problems", "steering", "step", "ends", "earned"),
    [
        # At 20 m + 17 1.2 m = 40.4 m, the first step in the region from 40 m to 60 m.
        pytest.param(
            CARS,
            problem(speeds=(11.0, 13.0), headings=(TURN - 0.1, TURN + 0.1)),
            0.0,
            17,
            ["success"],
            1.0,
            id="at the goal",
        ),
        pytest.param(
            CARS, problem(goal_right=WIDTH), 0.0, 40, [], 0.0, id="at the last time"
        ),
        pytest.param(
            car(100, 27, 0),
            problem(speed=25.0, goal=32.0, times=(2, 40)),
            0.0,
            2,
            ["collision"],
            -1.0,
            id="by a collision, in the region",
        ),
        pytest.param(
            car(100, 150, 0),
            problem(goal=190),
            -0.5,
            9,
            ["off_road"],
            -1.0,
            id="off the road",
        ),
    ],
)
def test_an_episode_ends_where_and_when_it_should(
    cars, problems, steering, step, ends, earned, tmp_path
):
    env, _ = begun(written(tmp_path, cars, problems))
    outcomes = []
    corners_off = []
    for outcome in steps(env, lambda _: np.array([0.0, steering])):
        outcomes.append(outcome)
        corners = env.axes.points(env.vehicle.polygon()[:-1])
        right = corners @ [np.sin(TURN), -np.cos(TURN)]
        is_off = (right < -WIDTH / 2 - SEAM) | (right > WIDTH * 1.5 + SEAM)
        corners_off.append(is_off.sum())
    _, reward, terminated, truncated, info = outcomes[-1]
    told = info["recorded"]
    assert [name for name in ("success", "collision", "off_road") if told[name]] == ends
    assert (told["step"], terminated, truncated) == (step, bool(ends), not ends)
    assert reward == pytest.approx(
        earned + 0.002 * 0.1 * env.vehicle.speed, abs=1e-4 if steering else 1e-6
    )
    assert not any(corners_off[:-1])
    assert 0 <= corners_off[-1] < 4
    assert (corners_off[-1] > 0) == ("off_road" in ends)


def test_each_of_several_planning_problems_can_be_driven(tmp_path):
    path = written(tmp_path, problems=PROBLEM + problem(30.0, number=8))
    egos = "problem", "problem:7", "problem:8"
    first, seventh, eighth = (
        begun(path, ego=ego)[0].vehicle.position[0] for ego in egos
    )
    assert first == seventh == pytest.approx(eighth - 10)
    assert [start.ego for start in starts_of(tmp_path, "problem")] == [
        "problem:7",
        "problem:8",
    ]


def turned(states, angle):
    """A recorded car that stands at another angle."""
    return [
        (step, x, y, orientation + angle, speed)
        for step, x, y, orientation, speed in states
    ]


@pytest.mark.parametrize("traffic", ["replay", "learned", "idm"])
def test_the_ego_replaces_the_vehicle_of_its_planning_problem(traffic, tmp_path):
    """The vehicle of another planning problem stays, and so does a car at the ego's
    bumper.
    """
    second = problem(40.0, WIDTH, number=8)
    cars = car(100, 21, 0.2) + car(101, 40, WIDTH) + car(102, 26, 0)
    path = written(tmp_path, cars, PROBLEM + second)
    for ego, own in (("problem:7", 100), ("problem:8", 101)):
        env, told = begun(path, traffic, ego)
        assert told["replaced"] == env.task.track == own
        assert others(env).keys() == {100, 101, 102} - {own}
        assert env.vehicle.position == pytest.approx(
            env.axes.positions(env.task.start[:2])
        )
        assert not env.step(idle())[4]["recorded"]["collision"]
    assert begun(path, traffic, 102)[1]["replaced"] == 102
    assert begun(written(tmp_path), traffic)[1]["replaced"] == -1


STILL = [(step, *place(20, 0), TURN, 0.0) for step in range(20)]


@pytest.mark.parametrize(
    "there",
    [
        car(102, 24, 0),  # the bumpers overlap
        car(102, 20, 1.5),  # the sides overlap
        moving(102, turned(STILL, 1.0)),  # it stands across the lane
        moving(102, STILL, "pillar"),
        standing(102, RECTANGLE, *place(20, 0)),
    ],
)
def test_an_obstacle_that_overlaps_the_start_is_refused(there, tmp_path):
    path = written(tmp_path, CARS + there)
    for start in (lambda: begun(path), lambda: starts_of(tmp_path, "problem")):
        with pytest.raises(
            ValueError,
            match=r"small\.xml: the start of the ego, .* overlaps obstacle 102; mend",
        ):
            start()


def test_lanes_of_two_directions_are_two_roads(tmp_path):
    env, _ = begun(written(tmp_path, lanelets=two_lanes("opposite")), "learned")
    left, right = sorted(set(straight_road(env.scenario).centres.values()))
    assert right - left == pytest.approx(2 * WIDTH)
    *_, (*_, info) = steps(env)
    assert info["recorded"]["success"]


def test_the_ego_goes_to_the_last_position_of_its_vehicle():
    env, told = begun(SHIPPED_RECORDING, ego=298)
    track = env.scenario.track(298)
    first, last = track.samples[[0, -1]]
    np.testing.assert_allclose(
        [told["step"], *state(env, env.vehicle)], first, atol=1e-6
    )
    assert track.size == (env.vehicle.LENGTH, env.vehicle.WIDTH)
    step, x, y, orientation, speed = last
    for late, in_time in ((0, True), (20, True), (21, False)):
        point = np.array([x, y])
        reached = env.task.is_reached(int(step) + late, point, orientation, speed)
        assert reached == in_time
    for _ in range(5):
        env.step(idle())
        assert 298 not in others(env)


def test_an_impossible_episode_leaves_the_old_one_as_it_was(tmp_path):
    env, _ = begun(written(tmp_path))
    before = dict(env.config)
    with pytest.raises(
        ValueError, match=r"config\['ego'\] is 7, .*; choose one of 100, 101"
    ):
        env.reset(options={"config": {"traffic": "idm", "ego": 7}})
    assert env.config == before
    assert env.step(idle())[4]["recorded"]["step"] == 1
    with pytest.raises(
        ValueError,
        match=r"small.xml: there is no lanelet under the start, \(39.1, -21.7\)",
    ):
        begun(written(tmp_path, problems=problem(right=40.0)))


def test_lanes_are_smooth_within_and_at_their_joints(us):
    for name in ("17_1", "14_1"):  # the second road has exits
        network = begun(us(name))[0].road.network
        joints = [
            (lane.shape, other.shape)
            for lane in road_map(network).lanes.values()
            for other in lane.following()
        ]
        assert len(joints) == 6
        for one, other in joints:
            gap = one.position(one.length, 0) - other.position(0, 0)
            assert np.linalg.norm(gap) < 0.05
            assert abs(one.heading_at(one.length) - other.heading_at(0)) < 0.02
        for lane in network.lanes_list():
            assert np.abs(np.diff(lane.curve.heading)).max() < 0.02


GRIP = 4.9  # m/s^2, of a robot


def driven_through(directory, radius, side, speed, angle=np.pi / 2):
    """Drive through a bend on an empty road; the largest offsets of a corner and of the
    robot's middle [m].
    """
    # The last time of the problem: after the bend, at the speed that grip allows.
    slowest = min(speed, np.sqrt(0.8 * GRIP * radius))
    seconds = 40 / speed + (radius * angle + 15) / slowest
    last = round(10 * seconds)
    there = problem(0.0, speed=speed, goal=None, times=(last, last + 1))

    # A file must have an obstacle: one far from the road.
    states = [(step, *place(-200, 100), TURN, 0.0) for step in range(2)]
    far = moving(100, states, "pillar")
    before = 40.0 if speed**2 < 160 else 120.0
    road = lanelet(1, 0.0, bend(radius, side, angle, before, after=80.0))
    path = directory / "bend.xml"
    path.write_text(scenario(lanelets=road, cars=far, problems=there))
    env = drive(
        gym.make(
            "ms-highway/recorded-v0",
            config={"recording": str(path), "traffic": "replay"},
        )
    )
    env.reset(seed=0)
    inner = env.unwrapped
    (lane,) = inner.road.network.lanes_list()
    corners = []
    middles = []
    accelerations = []
    done = False
    while not done:
        _, _, terminated, truncated, info = env.step(None)
        done = terminated or truncated
        _, offsets = lane.curve.locate(inner.vehicle.polygon()[:-1])
        corners.append(abs(offsets).max())
        middles.append(abs(lane.local_coordinates(inner.vehicle.position)[1]))
        accelerations.append(info["road"]["acceleration"])
    assert info["recorded"]["success"], (radius, side, speed, max(corners))
    assert max(accelerations) < 1.01 * GRIP
    return max(corners), max(middles)


@pytest.mark.parametrize("radius", [7, 12, 60])
def test_the_robot_stays_in_its_lane_in_sharp_bends(radius, tmp_path):
    """It comes to the last bend at twice the speed that its grip allows, and brakes."""
    limit = np.sqrt(GRIP * radius)
    for side, speed in ((1, limit), (-1, limit), (-1, 2 * limit)):
        corner, middle = driven_through(tmp_path, radius, side, speed)
        assert corner < WIDTH / 2
        assert middle < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("radius", [7, 12, 30, 60, 150, 300])
def test_the_robot_stays_in_its_lane_in_all_bends(radius, side, tmp_path):
    limit = np.sqrt(GRIP * radius)
    angle = np.pi if radius < 50 else np.pi / 2
    for speed in np.array([0.5, 0.85, 1.0, 2.0]) * limit:
        corner, _ = driven_through(tmp_path, radius, side, min(speed, 35.0), angle)
        assert corner < WIDTH / 2
