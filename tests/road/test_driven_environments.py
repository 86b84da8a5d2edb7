"""The robot in highway-env's own environments."""

import gymnasium as gym
import jax
import numpy as np
import pytest
from commands import run
from episodes import form
from gymnasium.envs.registration import registry

import ms_highway
from ms_highway.benchmarks.road.episodes import (
    Block,
    check_driver,
    run_episode,
    summary,
)
from ms_highway.envs.colors import PALETTE, model_color
from ms_highway.game.dynamics import keep_velocity
from ms_highway.loop.controller import HUMAN_DRIVERS
from ms_highway.perception.scene import SHAPE
from ms_highway.road.graphics import PANEL

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date:DeprecationWarning")

UNDRIVABLE = ("parking", "lane-keeping")
STOCK = [
    name
    for name, spec in registry.items()
    if "highway_env" in str(spec.entry_point) and not name.startswith(UNDRIVABLE)
]
CONTINUOUS = {"action": {"type": "ContinuousAction"}, "policy_frequency": 5}


def driven(name, driver="fixed:naive", **options):
    """A stock environment with a robot, just reset."""
    env = ms_highway.drive(gym.make(name, **options), {"driver": driver})
    env.reset(seed=0)
    return env


def forms(road):
    """Structure of an ``info``, type and shape of each entry, which recorders such as
    Minari's want to be constant.
    """
    return jax.tree.structure(road), [
        (type(value), np.shape(value)) for value in jax.tree.leaves(road)
    ]


@pytest.mark.parametrize("name", STOCK)
def test_every_stock_environment_keeps_its_interface_and_the_grip(
    name,
):
    stock = gym.make(name)
    env = ms_highway.drive(gym.make(name))
    assert (env.action_space, env.observation_space) == (
        stock.action_space,
        stock.observation_space,
    )
    observation, told = env.reset(seed=1)
    np.testing.assert_equal(observation, stock.reset(seed=1)[0])
    first = told["road"]
    assert np.isnan(first["decisions"]).all()
    assert first["action"] is None or np.isnan(first["action"]).all()
    observation, reward, terminated, _, info = env.step(env.action_space.sample())
    road = info["road"]
    rates = env.unwrapped.config
    assert forms(road) == forms(first)
    assert form(info) == form(told)
    assert env.observation_space.contains(observation)
    assert road["action"] is None or env.action_space.contains(road["action"])
    numbers = [road["planning_seconds"], road["decision_seconds"], road["jerk"]]
    assert np.isfinite([*numbers, *np.atleast_1d(reward)]).all()
    assert not np.any(terminated)
    for robot in env.robots:
        assert robot.last_step.source in ("proposal", "last plan", "braking")
        frames = rates["simulation_frequency"] // rates["policy_frequency"]
        assert len(robot.actions) == frames
        assert 0.0 <= max(robot.accelerations) <= 5.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        # A car that braked for others was predicted to go on.
        ("roundabout-v1", 1),
        # A crashed car was predicted to lie along its lane.
        ("roundabout-v0", 75),
        # A plan passed a wreck more closely than steps of 0.2 s resolve.
        ("roundabout-v0", 1014),
        # A plan could not drop behind a car beside it to let an oncoming car pass.
        ("two-way-v0", 59),
    ],
)
def test_the_robot_no_longer_crashes_where_it_did(name, seed):
    env = driven(name, "priced")
    env.reset(seed=seed)
    done = False
    while not done:
        *_, terminated, truncated, _ = env.step(None)
        done = terminated or truncated
    assert not env.unwrapped.vehicle.crashed


def test_a_step_of_a_second_counts_five_late_plans():
    road = driven("merge-v0", "budget:0.001").step(0)[4]["road"]
    assert np.isfinite(road["decisions"]).sum() == road["late"] == 5
    assert road["source"] == "last plan"


def test_actions_change_neither_an_episode_nor_its_time_limit():
    one = driven("two-way-v0")
    other = driven("two-way-v0")
    for step in range(15):
        outcome = one.step(0)
        same = other.step(3)
        np.testing.assert_array_equal(outcome[0], same[0])
        assert (outcome[1], outcome[4]["action"]) == (same[1], 1)  # IDLE
        assert outcome[2:4] == (False, step == 14)


def test_the_reported_action_repeats_the_step_or_is_nan():
    """In a turn, tyres change the control within some of the steps, which have three
    frames.
    """
    env = driven("intersection-v0", config=CONTINUOUS)
    stock = gym.make("intersection-v0", config=CONTINUOUS)
    stock.reset(seed=0)
    copy = stock.unwrapped.vehicle
    own = env.unwrapped.vehicle
    possible = []
    for _ in range(40):
        stock.unwrapped.road.vehicles = [copy]
        copy.position = own.position.copy()
        copy.heading = own.heading
        copy.speed = own.speed
        action = env.step(None)[4]["road"]["action"]
        stock.step(action)
        is_possible = env.action_space.contains(action)
        possible.append(is_possible)
        if is_possible:
            np.testing.assert_allclose(own.position, copy.position, atol=1e-3)
        else:
            assert np.isnan(action).all()
    assert possible.count(True) > 20 > possible.count(False) > 0


def test_a_step_without_a_reset_is_refused():
    env = ms_highway.drive(gym.make("highway-fast-v0"))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(None)
    env.reset(seed=0)
    env.env.reset(seed=1)
    with pytest.raises(
        gym.error.ResetNeeded, match="call reset of the driven environment"
    ):
        env.step(None)


def test_a_picture_shows_cars_in_the_colours_of_their_models():
    env = driven("roundabout-v0", "fixed:idm", render_mode="rgb_array")
    before = env.render()
    env.step(1)
    frame = env.render()
    height = env.unwrapped.config["screen_height"]
    assert before.shape == frame.shape == (height + PANEL, 600, 3)
    assert (frame[:height] == model_color("idm")).all(axis=-1).sum() > 100
    assert (frame[height] == PALETTE.paper).all()
    assert (frame[height:] != PALETTE.paper).any()


def test_vector_environments_collect_infos_of_ended_episodes():
    envs = gym.vector.SyncVectorEnv(
        [lambda: driven("intersection-v0", config={"duration": 2})] * 2
    )
    envs.reset(seed=[1, 2])
    envs.envs[1].unwrapped.config["duration"] = 3
    infos = [envs.step(envs.action_space.sample())[4]["road"] for _ in range(4)]
    assert all(
        len(road["models"][0]) == SHAPE.paths
        and road["gains"]["idm"].shape == (2, SHAPE.paths)
        for road in infos
    )


class Follows:
    """Keep to the target lane, and keep a distance to the car ahead that is drawn for
    the episode.
    """

    def reset(self, key):
        self.distance = np.random.default_rng(key).uniform(10.0, 30.0)
        self.seen = []

    def __call__(self, game, state):
        self.seen.append((game, state))
        aside, heading = state[0, 1:3]
        curvature = 0.02 * (float(game.scene.target_lane) - aside) - 0.5 * heading
        free = state[1, 0] < 0 or state[1, 0] - state[0, 0] > self.distance
        return keep_velocity(game.world, state[0]) + np.array(
            [curvature, 0.0 if free else -4.0]
        )


@pytest.fixture
def follows(monkeypatch):
    monkeypatch.setitem(HUMAN_DRIVERS, "follows", Follows)


@pytest.mark.usefixtures("follows")
@pytest.mark.parametrize("name", ["racetrack-v1", "merge-v0"])
def test_an_added_driver_drives_straightened_stock_roads(name):
    env = ms_highway.drive(gym.make(name), {"driver": "follows"})
    drives = []
    for seed in (3, 4, 3):
        _, first = env.reset(seed=seed)
        for _ in range(8):
            *_, terminated, _, info = env.step(None)
            if terminated:
                break
        drives.append([*env.unwrapped.vehicle.position, env.unwrapped.vehicle.speed])
        assert env.unwrapped.vehicle.on_road
    np.testing.assert_array_equal(drives[0], drives[2])
    assert not np.allclose(drives[0], drives[1])
    assert forms(info["road"]) == forms(first["road"])
    assert info["road"]["source"] == "driver"
    game, state = env.robots[0].driver._driver._function.seen[-1]
    assert state.shape == (7, 4)
    assert abs(state[0, 1:3]).max() < 1.0  # in the straightened lane
    assert float(game.world.time_step) == pytest.approx(0.2)
    assert not state.flags.writeable


@pytest.mark.usefixtures("follows")
def test_an_added_driver_is_measured_under_its_name():
    check_driver("follows")
    block = Block("merge-v0", "follows")
    figures = summary(block, [run_episode(block, seed) for seed in range(2)])
    assert figures["sources"] == {"driver": 1.0}
    assert figures["label"] == ""  # within its grip
    assert figures["p50_ms"] > 0
    with pytest.raises(
        ValueError, match=r"unknown driver 'folows'.*a name of add_driver or add_agent"
    ):
        check_driver("folows")
    # This one drives humans beside a robot.
    with pytest.raises(ValueError, match=r"config\['driver'\] is 'never'"):
        ms_highway.drive(gym.make("merge-v0"), {"driver": "never"})


@pytest.mark.slow
def test_an_added_planner_serves_paper_scenes_and_stock_roads(tmp_path):
    """A planner of the example drives in both under the same name."""
    asks = "--import notebooks.examples.agents"
    run(
        f"{asks} bench road merge-v0 --drivers merges --seeds 1 --json"
        f" {tmp_path / 'road.json'}"
    )
    run(
        f"{asks} compare merger-v1 --controllers merges --seeds 1 --out"
        f" {tmp_path / 'own'}"
    )
    assert (tmp_path / "own" / "summary.csv").is_file()
    assert (tmp_path / "road.json").is_file()
