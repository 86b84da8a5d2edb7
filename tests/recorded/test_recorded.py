"""Recorded traffic: of US-101, and of small scenarios written by hand, as an environment."""

import json
import warnings
from functools import partial
from io import BytesIO
from itertools import combinations, pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from highway_env.road.road import RoadNetwork
from recordings import (
    SPEED,
    TURN,
    car,
    headings,
    lanelet,
    linked_lanes,
    moving,
    pedestrian,
    place,
    problem,
    scenario,
    turning,
)

import ms_highway
from ms_highway.benchmarks.road.recorded import starts_of
from ms_highway.geometry.road_map import road_map
from ms_highway.recorded.commonroad import read_xml
from ms_highway.recorded.network import SampledLane
from ms_highway.recorded.problem import Task
from ms_highway.recorded.scenario import GoalRegion, Problem, open_recording
from ms_highway.recorded.traffic import overlap

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

CARS = car(100, 60, 0) + car(101, 40, 3.5)
WIDTH = 3.5  # m, of the lanes written by hand
SEAM = 0.1  # m, beyond the edges of the road that still counts as road


def written(directory, cars=CARS, problems=None, lanelets=None, **more):
    """The file of a small scenario; by default, with two lanes, two cars and a problem."""
    path = directory / "small.xml"
    problems = problem() if problems is None else problems
    lanelets = linked_lanes() if lanelets is None else lanelets
    path.write_text(scenario(lanelets=lanelets, cars=cars, problems=problems, **more))
    return str(path)


def idle(*_):
    """A continuous action, a new one each time, as `info` holds it."""
    return np.zeros(2)


def starting(env):
    """Stand for 12 steps, and drive off."""
    return np.array([0.0 if env.steps < 12 else 1.0, 0.0])


def make(file, traffic="replay", action="ContinuousAction", **config):
    """The environment of a file."""
    config = {"recording": str(file), "traffic": traffic, "action": {"type": action}, **config}
    return gym.make("ms-highway/recorded-v0", config=config)


def steps(env, act=idle, most=1000):
    """Drive an episode; yields what each step returns."""
    for _ in range(most):
        outcome = env.step(act(env.unwrapped))
        yield outcome
        if outcome[2] or outcome[3]:
            break


def braking(env, deceleration=3.0):
    """Brake until the ego stands, along its lane."""
    ego = env.vehicle
    along, right = ego.lane.local_coordinates(ego.position)
    turned = (ego.heading - ego.lane.heading_at(along) + np.pi) % (2 * np.pi) - np.pi
    return np.array([-min(deceleration, ego.speed / 0.1) / 5, np.clip(-0.2 * right - 4 * turned, -1, 1)])


def others(env):
    """The vehicles that traffic moves, by their number."""
    return {vehicle.track.number: vehicle for vehicle in env.unwrapped.road.others}


def overlapping(env):
    """Pairs of the others whose bodies overlap."""
    pairs = combinations(others(env).items(), 2)
    return {frozenset((number, second)) for (number, one), (second, other) in pairs if overlap(one, other)}


def poses(env, vehicle):
    """Position in the map, orientation there, and speed of a vehicle."""
    axes = env.unwrapped.axes
    return *axes.points(vehicle.position), float(axes.orientations(vehicle.heading)), vehicle.speed


@pytest.fixture(scope="module")
def us(us101_directory):
    """A function from the short name of a US-101 scenario to its file."""
    return lambda name: us101_directory / f"USA_US101-{name}_T-1.xml.gz"


@pytest.fixture(scope="module")
def stood(us):
    """Two episodes on US-101 whose ego brakes until it stands: the last info, the others each step, who overlapped."""
    found = {}
    for traffic in ("replay", "learned"):
        env, seen, pairs = make(us("17_1"), traffic), [], set()
        env.reset(seed=0)
        for *_, info in steps(env, braking):
            told = info["recorded"]
            pairs |= overlapping(env)
            seen.append({number: vehicle.speed for number, vehicle in others(env).items()})
        hit = {number for number, vehicle in others(env).items() if vehicle.crashed}
        found[traffic] = told, seen, pairs, hit
    return found


@pytest.mark.parametrize("action", [None, "DiscreteAction"])
def test_gymnasiums_checker_passes_without_a_warning(action, tmp_path):
    config = {"recording": written(tmp_path), **({"action": {"type": action}} if action else {})}
    env = gym.make("ms-highway/recorded-v0", render_mode="rgb_array", config=config)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_in_replay_everybody_is_where_it_was_recorded_at_each_step(us):
    env = make(us("17_1"))
    _, info = env.reset(seed=0)
    tracks = {track.number: track for track in env.unwrapped.scenario.tracks}
    for step in range(env.unwrapped.task.last + 1):
        there = {n: t.samples[t.samples[:, 0] == step] for n, t in tracks.items()}
        there = {number: rows[0] for number, rows in there.items() if len(rows)}
        assert info["recorded"]["step"] == step
        assert others(env).keys() == there.keys()
        for number, vehicle in others(env).items():
            x, y, orientation, speed = poses(env, vehicle)
            np.testing.assert_allclose([x, y, speed], there[number][[1, 2, 4]], rtol=0, atol=1e-6)
            assert abs(np.exp(1j * orientation) - np.exp(1j * there[number][3])) < 1e-9
            assert tracks[number].size == (vehicle.LENGTH, vehicle.WIDTH)
        *_, info = env.step(idle())
    assert len(there) < len(tracks) > 30


def test_who_is_behind_an_ego_that_stands_is_hit_in_replay_and_brakes_in_learned_traffic(stood):
    (replayed, went, _, hit), (learned, drove, _, unhurt) = stood["replay"], stood["learned"]
    assert (replayed["collision"], learned["collision"]) == (True, False)
    assert not unhurt
    (follower,) = hit
    assert went[len(went) - 1][follower] > 10.0
    assert drove[len(went) - 1][follower] < 0.7 * went[-1][follower]
    assert drove[-1][follower] < 3.0
    assert learned["step"] == 80


def test_learned_drivers_do_not_drive_through_each_other(stood):
    assert not stood["learned"][2] - stood["replay"][2]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["13_4", "26_2"])
def test_learned_drivers_do_not_hit_an_ego_that_brakes_gently(name, us):
    env = make(us(name), "learned")
    env.reset(seed=0)
    *_, (*_, info) = steps(env, partial(braking, deceleration=2.0))
    assert not info["recorded"]["collision"]


@pytest.mark.parametrize("kind", ["pedestrian", "train"])
@pytest.mark.parametrize("traffic", ["learned", "idm"])
def test_who_does_not_drive_goes_as_it_was_recorded(traffic, kind, tmp_path):
    env = make(written(tmp_path, CARS + pedestrian(102, 150, kind=kind)), traffic)
    env.reset(seed=0)
    (track,) = [track for track in env.unwrapped.scenario.tracks if track.number == 102]
    for (*_, info), sample in zip(steps(env), track.samples[1:], strict=False):
        assert info["recorded"]["step"] == sample[0]
        x, y, orientation, speed = poses(env, others(env)[102])
        np.testing.assert_allclose([x, y, orientation, speed], sample[1:], atol=1e-6)


@pytest.mark.parametrize("traffic", ["learned", "idm"])
def test_drivers_brake_for_who_stands_in_their_lane_and_does_not_drive(traffic, tmp_path):
    stands = moving(102, [(step, *place(95, 0), TURN, 0.0) for step in range(61)], "pillar")
    env = make(written(tmp_path, CARS + stands, problem(goal=190, times=(0, 60), speed=0.0)), traffic)
    env.reset(seed=0)
    *_, (*_, info) = steps(env)
    assert info["recorded"]["step"] == 60
    assert not overlapping(env)
    assert others(env)[100].speed < 6.0


def waiting(env, info):
    """The numbers of the vehicles that could not enter yet."""
    tracks = env.unwrapped.scenario.tracks
    return [track.number for track, waits in zip(tracks, info["recorded"]["waiting"], strict=True) if waits]


@pytest.mark.parametrize("traffic", ["learned", "idm"])
def test_a_car_whose_place_is_taken_waits_and_enters_there_later(traffic, tmp_path):
    late = car(102, 20, 0, samples=60, first=5)
    env = make(written(tmp_path, CARS + late, problem(speed=0.0, goal=190, times=(0, 60))), traffic)
    _, info = env.reset(seed=0)
    assert waiting(env, info) == []
    for *_, info in steps(env, starting):
        gap = env.unwrapped.vehicle.position[0] - env.unwrapped.axes.positions(place(20, 0))[0]
        if info["recorded"]["step"] < 5:
            assert waiting(env, info) == []
        elif info["recorded"]["step"] <= 12 or gap < 4.5:
            assert waiting(env, info) == [102]
            assert 102 not in others(env)
        elif 102 in others(env):
            break
    assert gap > 4.5
    assert waiting(env, info) == []
    np.testing.assert_allclose(env.unwrapped.axes.points(others(env)[102].position), place(20, 0), atol=0.1)


@pytest.mark.parametrize("turns", [-2, 0, 1])
@pytest.mark.parametrize("low", [-0.8, 3.0, 2 * np.pi - 0.1])
def test_a_goal_counts_from_its_first_heading_to_the_left_to_its_last_whatever_the_number_of_turns(low, turns):
    for last in (low + 0.3, low + 0.3 - 2 * np.pi):
        goal = GoalRegion((10, 20), headings=(low, last))
        task = Task(Problem(1, (0.0, 0.0, 0.0, 0.0), 0, (goal,)), (4.5, 1.8))
        given = [low + turns * 2 * np.pi + more for more in (-0.001, 0.001, 0.15, 0.299, 0.301, np.pi)]
        found = [task.is_reached(15, (5.0, 2.0), orientation, 10.0) for orientation in given]
        assert found == [False, True, True, True, False, False]


def test_a_goal_is_reached_where_commonroads_own_reader_finds_it_reached(us):
    from commonroad.common.reader.file_reader_xml import XMLFileReader
    from commonroad.scenario.state import CustomState

    (theirs,) = XMLFileReader(BytesIO(read_xml(us("29_1")))).open()[1].planning_problem_dict.values()
    task = Task.of(open_recording(str(us("29_1"))), "problem")
    (goal,) = task.problem.goals
    rng = np.random.default_rng(0)
    drawn = rng.uniform(-1.1, 1.1, (400, 4)) * [2.0, 2.0, np.ptp(goal.headings) / 2, np.ptp(goal.speeds) / 2]
    drawn += [*goal.area.mean(axis=0), np.mean(goal.headings), np.mean(goal.speeds)]
    found = []
    for (x, y, orientation, speed), step in zip(drawn, rng.integers(37, 50, len(drawn)).tolist(), strict=True):
        state = CustomState(position=np.array([x, y]), orientation=orientation, velocity=speed, time_step=step)
        found.append(bool(theirs.goal.is_reached(state)))
        assert task.is_reached(step, (x, y), orientation, speed) == found[-1]
    assert 30 < sum(found) < 370


@pytest.mark.parametrize(
    ("changes", "step"),
    [
        ({}, 17),  # at 20 m + 17 1.2 m = 40.4 m, the first step in the region from 40 m to 60 m
        ({"times": (25, 40)}, 25),
        ({"speeds": (11.0, 13.0), "headings": (TURN - 0.1, TURN + 0.1)}, 17),
        ({"speeds": (12.5, 13.0)}, None),
        ({"goal_right": WIDTH}, None),
    ],
)
def test_success_ends_the_episode_and_comes_only_within_all_of_the_goals_intervals(changes, step, tmp_path):
    env = make(written(tmp_path, problems=problem(**changes)))
    env.reset(seed=0)
    outcomes = list(steps(env))
    *_, (_, reward, terminated, truncated, info) = outcomes
    last = changes.get("times", (10, 40))[1]
    assert (terminated, truncated) == (step is not None, len(outcomes) == last)
    assert info["recorded"]["step"] == len(outcomes) == (step or last)
    assert info["recorded"]["success"] == (step is not None)
    assert reward == pytest.approx((step is not None) + 0.002 * SPEED * 0.1, abs=1e-6)


def test_each_of_several_planning_problems_can_be_driven(tmp_path):
    second = problem(30.0).replace('planningProblem id="7"', 'planningProblem id="8"')
    path = written(tmp_path, problems=problem(20.0) + second)
    starts = {}
    for ego in ("problem", "problem:7", "problem:8"):
        env = make(path, ego=ego)
        env.reset(seed=0)
        starts[ego] = env.unwrapped.vehicle.position[0]
    assert starts["problem"] == starts["problem:7"] == pytest.approx(starts["problem:8"] - 10)
    assert [start.ego for start in starts_of(tmp_path, "problem")] == ["problem:7", "problem:8"]


@pytest.mark.parametrize("traffic", ["replay", "learned"])
def test_a_collision_ends_the_episode_without_success(traffic, tmp_path):
    cars = car(100, 27, 0, samples=60)
    env = make(written(tmp_path, cars, problem(speed=25.0, goal=32.0, times=(2, 40))), traffic)
    env.reset(seed=0)
    *_, (_, reward, terminated, truncated, info) = steps(env)
    told = info["recorded"]
    assert (terminated, truncated, told["collision"], told["success"]) == (True, False, True, False)
    ego, other = env.unwrapped.vehicle, others(env)[100]
    assert overlap(ego, other)
    assert told["step"] == 2
    assert -1.0 < reward < -0.9


@pytest.mark.parametrize("side", [-1, 1])
def test_leaving_the_road_by_a_corner_ends_the_episode(side, tmp_path):
    right = 0.0 if side < 0 else WIDTH
    env = make(written(tmp_path, car(100, 150, 0, samples=60), problem(right=right, goal=190)))
    env.reset(seed=0)
    axes, ego, outcomes, rights = env.unwrapped.axes, env.unwrapped.vehicle, [], []
    for outcome in steps(env, lambda _: np.array([0.0, 0.5 * side])):
        outcomes.append(outcome)
        rights.append(axes.points(ego.polygon()[:-1]) @ [np.sin(TURN), -np.cos(TURN)])
    out = [(corners < -WIDTH / 2 - SEAM) | (corners > WIDTH * 1.5 + SEAM) for corners in rights]
    *_, (_, reward, terminated, _, info) = outcomes
    assert (terminated, info["recorded"]["off_road"], info["recorded"]["success"]) == (True, True, False)
    assert not np.any(out[:-1])
    assert 0 < out[-1].sum() < 4
    assert -1.0 < reward < -0.9


def test_the_ego_in_the_place_of_a_recorded_vehicle_goes_to_its_last_position(us):
    env = make(us("17_1"), ego=278)
    _, info = env.reset(seed=0)
    base = env.unwrapped
    (track,) = [track for track in base.scenario.tracks if track.number == 278]
    first, last = track.samples[[0, -1]]
    np.testing.assert_allclose(poses(env, base.vehicle), first[1:], atol=1e-6)
    assert track.size == (base.vehicle.LENGTH, base.vehicle.WIDTH)
    assert info["recorded"]["step"] == first[0]
    for step, right in ((last[0], True), (last[0] + 20, True), (last[0] + 21, False)):
        assert base.task.is_reached(int(step), last[1:3], last[3], last[4]) == right
    assert base.goal.spot.lane == base.road.network.get_closest_lane_index(base.axes.positions(last[1:3]))
    for _ in range(5):
        env.step(idle())
        assert 278 not in others(env)


@pytest.mark.parametrize(
    ("file", "config", "message"),
    [
        ({"problems": problem(right=40.0)}, {}, r"small.xml: there is no lanelet under the start, \(39.1, -21.7\)"),
        ({"lanelets": linked_lanes("opposite")}, {}, r"small.xml: lanelet 1 .* only roads of one direction can be dr"),
        ({"lanelets": linked_lanes().replace('ref="4" driv', 'ref="2" driv')}, {}, "lanelet 2 is beside itself"),
        (
            {"cars": CARS + car(103, 5, 0, 1)},
            {"ego": 103},
            r"config\['ego'\] is 103, which is no vehicle that was seen twice; choose one of 100, 101",
        ),
        (
            {},
            {"ego": "problem:8"},
            r"small.xml: there is no planning problem 8, config\['ego'\]; choose 'problem:7' or a vehicle",
        ),
        ({}, {"recording": "us102"}, r"config\['recording'\] is 'us102', which is no file; give .* or 'us101'"),
        ({}, {"observation": {"type": "CarStates"}}, r"config\['observation'\] is .*; its 'type' must be one of"),
    ],
)
def test_what_cannot_be_driven_is_refused_by_name_with_what_to_do(file, config, message, tmp_path):
    path = written(tmp_path, **file)
    with pytest.raises(ValueError, match=message) as error:
        make(path, **config).reset(seed=0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("change", [{"ego": 7}, {"trafic": "idm"}, {"recording": "missing.xml"}])
def test_after_a_failed_reset_the_old_episode_goes_on(change, tmp_path):
    env = make(written(tmp_path))
    env.reset(seed=0)
    env.step(idle())
    before = dict(env.unwrapped.config)
    with pytest.raises(ValueError, match=r"small\.xml|missing\.xml|trafic"):
        env.reset(options={"config": {"traffic": "idm", **change}})
    assert env.unwrapped.config == before
    assert env.step(idle())[4]["recorded"]["step"] == 2


def network_of_file(us, name):
    """The road network of a recording, and the environment."""
    env = make(us(name))
    env.reset(seed=0)
    return env.unwrapped.road.network, env.unwrapped


@pytest.fixture(scope="module")
def merge(us):
    return network_of_file(us, "17_1")


@pytest.fixture(scope="module")
def exits(us):
    return network_of_file(us, "14_1")


def test_lanes_go_on_smoothly_over_joints_and_within_themselves(merge, exits):
    for network, _ in (merge, exits):
        joints = [(lane.shape, other.shape) for lane in road_map(network).lanes.values() for other in lane.following()]
        assert len(joints) == 6
        for one, other in joints:
            assert np.linalg.norm(one.position(one.length, 0) - other.position(0, 0)) < 0.05
            assert abs(one.heading_at(one.length) - other.heading_at(0)) < 0.02
        for lane in network.lanes_list():
            assert np.abs(np.diff(lane.curve.heading)).max() < 0.02


def test_lane_coordinates_lead_back_to_positions(merge, exits):
    for network, _ in (merge, exits):
        for lane in network.lanes_list():
            for along in np.linspace(-20.0, lane.length + 20.0, 30):
                for right in (-2.0, 1.5):
                    found = lane.local_coordinates(lane.position(along, right))
                    np.testing.assert_allclose(found, (along, right), rtol=0, atol=0.01)


def test_lanes_are_as_wide_and_go_where_the_file_says(merge):
    network, env = merge
    lanes = network.lanes_list()
    assert len(lanes) == len(env.scenario.lanelets)
    for piece in env.scenario.lanelets:
        middles = env.axes.positions(piece.centre)
        places = {lane: np.array([lane.local_coordinates(point) for point in middles]) for lane in lanes}
        beyond = {
            lane: abs(y).max() + max(0, -x.min()) + max(0, x.max() - lane.length)
            for lane, (x, y) in ((lane, found.T) for lane, found in places.items())
        }
        lane = min(lanes, key=beyond.get)
        assert beyond[lane] <= 0.1
        found = [lane.width_at(along) for along, _ in places[lane]]
        np.testing.assert_allclose(found, np.linalg.norm(piece.left - piece.right, axis=-1), rtol=0, atol=0.05)


def test_lanes_and_networks_are_the_same_after_json(exits):
    network, _ = exits
    again = RoadNetwork.from_config(json.loads(json.dumps(network.to_config())))
    assert again.lanes_dict().keys() == network.lanes_dict().keys()
    for lane, copy in zip(network.lanes_list(), again.lanes_list(), strict=True):
        assert isinstance(copy, SampledLane)
        assert copy.to_config() == lane.to_config()
        np.testing.assert_array_equal(copy.position(17.3, 0.4), lane.position(17.3, 0.4))


@pytest.mark.parametrize("radius", [5, 15, 30, 100])
@pytest.mark.parametrize("pieces", [1, 3])
def test_lanes_do_not_cut_curves(radius, pieces, tmp_path):
    line, links = turning(radius), '<predecessor ref="{}"/><successor ref="{}"/>'
    cuts = [0, len(line) - 1] if pieces == 1 else [0, 55, len(line) - 56, len(line) - 1]
    bounds = pairwise(cuts)
    parts = [line[first : last + 1] for first, last in bounds]
    if pieces == 3:  # straight lanelets of two points, as files have them
        parts[0], parts[-1] = parts[0][[0, -1]], parts[-1][[0, -1]]
    lanelets = "".join(lanelet(n, 0, part, links.format(n - 1, n + 1)) for n, part in enumerate(parts, 1))
    run = [
        (step, *point, heading, 10.0) for step, (point, heading) in enumerate(zip(line, headings(line), strict=True))
    ]
    env = make(written(tmp_path, moving(100, run), lanelets=lanelets, problems=""), ego=100)
    env.reset(seed=0)
    base = env.unwrapped
    lanes = base.road.network.lanes_list()
    aside = [min(abs(lane.local_coordinates(position)[1]) for lane in lanes) for position in base.axes.positions(line)]
    assert max(aside) < 0.1
    assert sum(lane.length for lane in lanes) == pytest.approx(120 + np.pi / 2 * radius, rel=0.02)


def test_a_lanelet_with_a_corner_is_refused_with_the_reason(tmp_path):
    corner = np.concatenate([np.linspace([-60, 0], [0, 0], 60), np.linspace([0, 1], [0, 60], 59)])
    lanelets = lanelet(1, 0, corner)
    run = moving(100, [(step, 6 * step - 50, 0, 0, 10.0) for step in range(5)])
    with pytest.raises(ValueError, match=r"small\.xml: lanelet 1 turns too sharply: .* 0\.\d\d m off its own"):
        make(written(tmp_path, run, lanelets=lanelets, problems=""), ego=100).reset(seed=0)


@pytest.mark.parametrize(
    ("name", "traffic"),
    [
        ("17_1", "learned"),
        pytest.param("28_1", "replay", marks=pytest.mark.slow),
    ],
)
def test_the_robot_keeps_appointments_on_us101(name, traffic, us):
    env = ms_highway.drive(make(us(name), traffic))
    env.reset(seed=0)
    *_, (*_, info) = steps(env, lambda _: None)
    told = info["recorded"]
    assert env.unwrapped.task.size == (env.unwrapped.vehicle.LENGTH, env.unwrapped.vehicle.WIDTH)
    (goal,) = env.unwrapped.task.problem.goals
    assert (told["success"], told["collision"], told["off_road"]) == (True, False, False)
    assert info["road"]["success"]
    assert goal.times[0] <= told["step"] <= goal.times[1]
    assert goal.speeds[0] <= env.unwrapped.vehicle.speed <= goal.speeds[1]
