"""The environments as Gymnasium users meet them."""

import gymnasium as gym
import numpy as np
import pytest
from commands import python
from episodes import drive, make
from gymnasium.utils.env_checker import check_env

import ms_highway
from ms_highway.data.learned_reward import shipped
from ms_highway.envs import PAPER_SCENARIOS, SCENARIOS
from ms_highway.envs.demonstration import ACTION
from ms_highway.envs.info import Timing
from ms_highway.game.reward import COMFORT
from ms_highway.game.scenario import COMMON_WEIGHTS
from ms_highway.planning.human_models import PredictedHuman
from ms_highway.planning.ladders import MODELS

CHOOSING = {"type": "HumanModelAction", "lambda": 0.1}
DRIVING = {"type": "ContinuousAction"}


@pytest.mark.parametrize(
    ("scenario", "action"),
    [("merger", {"type": "Autopilot"}), ("merger", CHOOSING), ("dense_merge", DRIVING)],
)
def test_gymnasiums_checker_passes_without_a_warning(scenario, action):
    env = make(
        scenario,
        render_mode="rgb_array",
        action=action,
        ladder=["naive", "turn"],
        duration=0.3,
    )
    check_env(env.unwrapped)  # a warning would be an error


@pytest.fixture(scope="module")
def turned():
    """An episode of a robot under turn."""
    return drive(make("merger", "turn"))


def test_info_holds_the_reward_by_feature_and_measured_times(turned):
    infos = turned.infos
    for reward, info in zip(turned.rewards, infos, strict=True):
        assert sum(info["rewards"].values()) == pytest.approx(reward)
        assert (info["status"], info["human_status"]) == ("planned", ("planned",))
        assert (info["model"], info["models"], info["collision"]) == (
            "turn",
            ("turn",),
            False,
        )
        assert 0 < info["timing"].planning_seconds < 1


def test_times_do_not_count_when_episodes_are_compared(turned):
    _, first, second, *_ = [info["timing"] for info in turned.infos]
    assert first == second == Timing(1.0, 2.0, 3.0)
    assert (np.asarray(first) != np.asarray(second)).any()


@pytest.mark.parametrize(
    ("scenario", "kind", "action", "message"),
    [
        (
            "merger",
            DRIVING,
            np.array([0.0, np.nan]),
            r"nan.* is impossible; give one of Box\(-1.0, 1.0",
        ),
        (
            "merger",
            DRIVING,
            [1, 0, 9, 9],
            r"action \[1, 0, 9, 9\] is impossible; give one of Box\(-1.0, 1.0, \(2,\)",
        ),
        ("merger", DRIVING, [[1, 0], [1]], r"action .* is impossible; give one of Box"),
        ("merger", DRIVING, 1.0, r"action 1.0 is impossible; give one of Box"),
        (
            "merger",
            DRIVING,
            ["0", None],
            r"action \['0', None\] is impossible; give one of Box",
        ),
        (
            "merger",
            {"type": "DiscreteAction"},
            9,
            r"action 9 is impossible; give one of Discrete\(9\)",
        ),
        (
            "merger",
            {"type": "DiscreteAction"},
            0.5,
            r"action 0.5 is impossible; give one of Discrete\(9\)",
        ),
        (
            "dense_merge",
            CHOOSING,
            1,
            r"action 1 is impossible; give one of MultiDiscrete",
        ),
    ],
)
def test_an_impossible_action_is_refused_before_anything_moves(
    scenario, kind, action, message
):
    env = make(scenario, action=kind).unwrapped
    env.reset(seed=0)
    before = env.car_states
    with pytest.raises(ValueError, match=message):
        env.step(action)
    np.testing.assert_array_equal(env.car_states, before)
    assert (env.time, env.steps) == (0, 0)


def test_a_control_divided_by_the_ranges_is_its_action(
    turned,
):
    copy = make("merger", action=ACTION)
    controls = [info["control"] for info in turned.infos]
    copy.reset(seed=0)
    for control, state in zip(controls, turned.states[1:], strict=True):
        shares = [
            control[name] / ACTION[f"{name}_range"][1]
            for name in ("acceleration", "steering")
        ]
        copy.step(np.float32(shares))
        np.testing.assert_allclose(
            copy.unwrapped.robot.position, state[0, :2], rtol=0, atol=1e-3
        )
    assert (
        max(abs(control["acceleration"]) for control in controls) > 5.0
    )  # beyond the default range


def test_gradient_steps_suit_the_horizon_and_longer_ones_warn():
    assert make("merger", horizon=10).unwrapped.game.planner.solver.iterations == 58
    with pytest.warns(
        UserWarning, match=r"step_size'\] is 0.03: plans of 10 steps of 0.1 s overshoot"
    ) as warned:
        make("merger", horizon=10, step_size=0.03)
    assert [each.category for each in warned].count(UserWarning) == 1


def test_a_model_without_finite_predictions_warns_and_costs(
    monkeypatch,
):
    lost = type(
        "Lost",
        (PredictedHuman,),
        {"name": "lost", "predict": lambda *_: np.full((5, 2), np.nan)},
    )
    monkeypatch.setitem(MODELS, "lost", lost())
    env = make(
        "merger",
        action=CHOOSING,
        ladder=["naive", "lost"],
        costs={"naive": 0.01, "lost": 0.1},
    )
    env.reset(seed=0)
    with pytest.warns(
        UserWarning,
        match="model 'lost' predicts a curvature of nan 1/m, so that no plan follows",
    ):
        env.step(0)
    for action, status, seconds in ((1, "previous plan", 0.1), (0, "planned", 0.01)):
        info = env.step(action)[-1]
        assert (info["status"], info["counted_seconds"]) == (
            status,
            pytest.approx(seconds),
        )


def test_a_collision_costs_reward_and_ends_episodes_if_asked():
    starts = np.array([[0, 0, 0.0, 20.0], [-8, -3.3, 0.0, 20.0], [3, 0.0, 0.0, 20.0]])
    for terminate, steps in ((False, 2), (True, 1)):
        _, states, rewards, infos = drive(
            make("merger", terminate_on_collision=terminate), starts=starts, steps=2
        )
        assert infos[0]["collision"]
        assert infos[0]["crashed"]
        assert rewards[0] < -90
        assert len(rewards) == steps
        np.testing.assert_allclose(
            states[1, 2], starts[2] + [2.0, 0, 0, 0]
        )  # no push, no freeze


@pytest.mark.parametrize(
    ("config", "missing"),
    [({"action": DRIVING}, [np.nan] * 2), ({"action": {"type": "DiscreteAction"}}, -1)],
)
def test_info_tells_no_action_before_the_first_step(config, missing):
    env = make("merger-v1", **config)
    np.testing.assert_array_equal(env.reset(seed=0)[1]["action"], missing)
    action = env.action_space.sample()
    np.testing.assert_array_equal(env.step(action)[4]["action"], action)
    np.testing.assert_array_equal(env.reset(seed=1)[1]["action"], missing)


@pytest.mark.parametrize(
    "name", ["merger-v1", "demonstration-v0", "recorded-v0", "merge-v1"]
)
def test_seeds_are_whole_numbers_also_of_numpy(name):
    env = (
        ms_highway.drive(gym.make(name))
        if name == "merge-v1"
        else gym.make(f"ms_highway:ms-highway/{name}")
    )
    same = [env.reset(seed=seed)[0] for seed in (3, np.int64(3), np.int32(3))]
    np.testing.assert_array_equal(same[1:], [same[0]] * 2)
    for seed in (1.5, np.float64(3.0), -1, "3", True, [3]):
        with pytest.raises(
            ValueError,
            match=r"the seed of reset is .*; give a whole number from 0 on, or None",
        ):
            env.reset(seed=seed)


@pytest.mark.parametrize(
    ("scenario", "controller", "config"),
    [
        ("merger", "learned:1", {}),
        ("merger", "switching:0.1+belief", {"yielding": "never"}),
        ("dense_merge", "nearest:1", {"semantics": "physical"}),
    ],
)
def test_whole_turns_of_a_heading_change_no_episode(scenario, controller, config):
    env = make(scenario, controller, **config)
    env.reset(seed=0)
    starts = env.unwrapped.car_states - [0, 0, 0.01, 0]
    turns = 2 * np.pi * np.eye(4)[2] * np.arange(1, 1 + len(starts))[:, None]
    plain, turned = (
        drive(env, starts=given, steps=3) for given in (starts, starts + turns)
    )
    assert [info["model"] for info in turned.infos] == [
        info["model"] for info in plain.infos
    ]
    for name in ("gains", "rewards"):
        for one, other in zip(turned.infos, plain.infos, strict=True):
            assert one[name] == pytest.approx(other[name], rel=1e-3, abs=1e-4)
    np.testing.assert_allclose(turned.states, plain.states, atol=1e-5)


@pytest.mark.parametrize("name", ["merger-v0", "merger-v1", "demonstration-v0"])
def test_no_observation_tells_whole_turns_of_a_heading(name):
    env = gym.make(f"ms_highway:ms-highway/{name}").unwrapped
    observation, _ = env.reset(seed=0)
    for car in env.road.vehicles:
        car.heading += 2 * np.pi
    np.testing.assert_allclose(env.observation_type.observe(), observation, atol=1e-5)


def test_action_spaces_and_frame_rates_are_an_environments_own():
    env = make("merger", action=CHOOSING).unwrapped
    shared = dict(type(env).metadata)
    space = env.action_space
    space.seed(5)
    env.reset(seed=0)
    assert env.action_space is space  # and keeps its seed
    assert env.metadata["render_fps"] == 10
    assert type(env).metadata == shared


def weights_of(game):
    """The human's reward by name, without zeros."""
    humans = game.humans
    values = zip(
        (*humans.names, *COMFORT), (*humans.weights[0], *humans.comfort), strict=True
    )
    return {name: float(value) for name, value in values if value}


def test_given_weights_change_humans_and_their_models_alike():
    own = []
    believed = []
    for reward in ("published", {"speed": 40.0, "lane_alignment": 75.0, "gap": 0.0}):
        env = make("merger", "turn", human_reward=reward)
        starts = [[0, 0, 0, 20.0], [-30, -3.3, 0, 18.0], [-14, -3.3, 0, 20.0]]
        inner, *_ = drive(env, starts=starts, steps=1)
        own.append(inner.humans[0].last_step.control)
        believed.append(inner.robot.last_step.humans[0, 0])
    assert weights_of(inner.game) == {
        "speed": 40.0,
        "lane_alignment": 75.0,
        "target_lane": 1000.0,
    }
    np.testing.assert_allclose(own, believed, atol=1e-3)
    assert abs(own[0][1] - own[1][1]) > 0.5


VECTOR = """
import gymnasium as gym
import numpy as np

def work(context):
    envs = gym.make_vec(
        "ms_highway:ms-highway/merger-v0",
        num_envs=2,
        vectorization_mode="async",
        vector_kwargs={"context": context},
        config={"controller": "naive", "costs": "measured"},
    )
    envs.reset(seed=[3, 3])
    observations, rewards, _, _, infos = envs.step(np.zeros(2, dtype=int))
    envs.close()
    assert (observations[0] == observations[1]).all()
    assert rewards[0] == rewards[1] != 0
    assert list(infos["model"]) == ["naive", "naive"]

if __name__ == "__main__":
    work(None)
    work("forkserver")
"""


@pytest.mark.slow
def test_all_kinds_of_workers_find_and_step_environments(tmp_path):
    script = tmp_path / "vector.py"
    script.write_text(VECTOR)
    assert python(script, timeout=600).stderr == ""


@pytest.mark.parametrize(
    ("costs", "controller", "clocked"),
    [
        ("measured", "switching:0.1", True),
        ("measured", "naive", False),
        ("published", "budget:500", True),
    ],
)
def test_info_tells_whether_rules_chose_by_measured_times(costs, controller, clocked):
    env = make("merger", controller, ladder=["naive", "turn"], costs=costs)
    assert drive(env, steps=1).infos[0]["clocked"] == clocked


UNBEGUN = """
import gymnasium as gym
from jax._src import xla_bridge

import ms_highway

controllers = [
    {"type": "learned", "lambda": 1.0},
    {"type": "switching", "lambda": 1.0},
    {"type": "horizon", "lambda": 1.0},
    {"type": "budget", "milliseconds": 20},
    {"type": "nearest", "count": 1},
]
for name in [name for name in gym.registry if name.startswith("ms-highway/")]:
    for controller in controllers:
        chooses = "demonstration" not in name and "recorded" not in name
        env = gym.make(name, config={"controller": controller} if chooses else {})
        env.reset(seed=0)
        assert not xla_bridge.backends_are_initialized(), (name, controller)
"""


@pytest.mark.slow
def test_no_environment_begins_to_compute_before_its_first_step():
    assert python("-c", UNBEGUN).stderr == ""


FORKED = """
import multiprocessing
import warnings

import gymnasium as gym
import ms_highway
import numpy as np
from jax import numpy as jnp

jnp.ones(3).sum()
merger = "ms-highway/merger-v1"
driven = {"action": {"type": "ContinuousAction"}}
envs = gym.make_vec(merger, num_envs=2, config=driven)
functions = ms_highway.FunctionalEnv(merger, driven)
envs.reset(seed=0)
actions = np.zeros((2, 2), np.float32)
warnings.simplefilter("ignore")  # JAX and Python warn of the fork


def work():
    controller = {"type": "fixed", "model": "naive"}
    env = gym.make("ms-highway/merger-v0", config={"controller": controller})
    env.reset(seed=0)
    inner = env.unwrapped
    demonstration = gym.make("ms-highway/demonstration-v0")
    demonstration.reset(seed=0)
    for compute in (
        lambda: env.step(0),
        lambda: ms_highway.plan(inner.game, inner.car_states, "naive"),
        lambda: demonstration.step(actions[0]),
        lambda: gym.make_vec(merger, num_envs=2, config=driven),
        lambda: envs.reset(seed=0),
        lambda: envs.step(actions),
        lambda: ms_highway.FunctionalEnv(merger, driven),
        lambda: functions.reset(0),
        lambda: functions.step(None, actions[0]),
        lambda: ms_highway.predict([[0.0, 0.0, 0.0, 20.0]], [0.0], 29.0),
    ):
        try:
            compute()
        except RuntimeError as error:
            print(error, flush=True)


worker = multiprocessing.get_context("fork").Process(target=work)
worker.start()
worker.join()
"""


@pytest.mark.slow
def test_a_worker_forked_after_jax_began_raises_an_error():
    assert (
        python("-c", FORKED, timeout=600).stdout.count(
            "start it with context='forkserver' or 'spawn'"
        )
        == 10
    )


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("demonstration", "ContinuousAction"),
        ("merger", "DiscreteAction"),
        ("recorded", "ContinuousAction"),
    ],
)
def test_full_braking_reverses_only_within_a_range_of_speeds(name, kind):
    brakes = np.array([-1.0, 0.0], np.float32) if kind == "ContinuousAction" else 1
    for speeds, lowest in (({}, 0.0), ({"speed_range": [-2.0, 30.0]}, -2.0)):
        env = gym.make(
            f"ms-highway/{name}-v0", config={"action": {"type": kind, **speeds}}
        ).unwrapped
        env.reset(seed=0)
        env.vehicle.speed = 1.0
        driven = [(env.step(brakes), env.vehicle.speed)[1] for _ in range(8)]
        assert driven[-1] == min(driven) == pytest.approx(lowest, abs=1e-6)


@pytest.mark.parametrize("name", PAPER_SCENARIOS)
def test_semantics_choose_the_humans_reward_and_leave_the_robots(name):
    scenario = SCENARIOS[name]
    aims = {
        feature: weight
        for feature, weight in scenario.human_weights.items()
        if feature not in COMMON_WEIGHTS
    }
    for semantics, driving in (
        ("paper", shipped("demonstrations").weights),
        ("released", COMMON_WEIGHTS),
    ):
        game = make(name, semantics=semantics).unwrapped.game
        assert weights_of(game) == pytest.approx(driving | aims)
        robot = zip(game.robot.names, game.robot.weights.tolist(), strict=True)
        assert {
            feature: weight for feature, weight in robot if weight
        } == scenario.robot_weights
