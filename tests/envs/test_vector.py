"""Many environments at once in JAX equal single environments."""

import gymnasium as gym
import jax
import numpy as np
import pytest
from episodes import TWO, form
from gymnasium.vector import AutoresetMode

from ms_highway import FunctionalEnv
from ms_highway.envs import scenario_name
from ms_highway.game.starts import TracedRandom

CHOOSING = {
    "action": {"type": "HumanModelAction", "lambda": 1.0},
    "ladder": ["naive", "turn"],
}
LEARNED = {"controller": "learned:1", "ladder": ["naive", "turn"]}
DRIVING = {"action": {"type": "ContinuousAction"}, **TWO}
NAME = "ms_highway:ms-highway/"


def both(scenario, config, number=3, mode=AutoresetMode.NEXT_STEP):
    """The vector environment of a scenario, and Gymnasium's of single environments."""
    arguments = {"id": NAME + scenario, "num_envs": number, "config": config}
    ours = gym.make_vec(autoreset_mode=mode, **arguments)
    ours.action_space.seed(0)
    return ours, gym.make_vec(
        vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **arguments
    )


@pytest.mark.parametrize(
    ("scenario", "config"),
    [
        ("merger-v1", CHOOSING),
        ("merger-v1", LEARNED),
        ("dense-merge-v0", CHOOSING | TWO),
    ],
)
def test_each_environment_equals_a_single_one_of_its_seed(scenario, config):
    ours, singles = both(scenario, config | {"duration": 2.0})
    mine = ours.reset(seed=5)
    other = singles.reset(seed=5)
    np.testing.assert_allclose(mine[0], other[0], atol=1e-5)
    first = form(mine[1])
    told = other[1]
    for name in mine[1]:
        np.testing.assert_array_equal(mine[1][name], told[name], name)
    for _ in range(20):
        actions = ours.action_space.sample()
        mine = ours.step(actions)
        other = singles.step(actions)
        assert form(mine[4]) == first
        np.testing.assert_allclose(mine[0], other[0], atol=1e-4)
        np.testing.assert_allclose(mine[1], other[1], atol=2e-3)
        for name in {*mine[4]} - {"counted_seconds"}:  # which may differ by rounding
            np.testing.assert_array_equal(mine[4][name], other[4][name], name)


def test_first_steps_in_chaos_agree_with_single_environments():
    """Later, rounding decides which models are chosen; notebooks/REFERENCE.md says by
    how much episodes differ.
    """
    ours, singles = both("stay-back-v1", {"controller": "learned:1"}, number=2)
    ours.reset(seed=7), singles.reset(seed=7)
    for _ in range(3):
        actions = np.zeros(2, int)
        mine = ours.step(actions)
        other = singles.step(actions)
        np.testing.assert_array_equal(mine[4]["model"], other[4]["model"])
        np.testing.assert_allclose(mine[1], other[1], atol=1e-3)
        states = np.stack(
            [single.unwrapped.car_states for single in singles.unwrapped.envs]
        )
        np.testing.assert_allclose(ours.unwrapped._state.now.state, states, atol=0.02)


def test_a_robot_that_has_collided_does_not_succeed():
    ours, singles = both("dense-merge-v0", DRIVING)
    ours.reset(seed=0), singles.reset(seed=0)
    actions = np.tile(np.float32([0.0, -0.3]), (3, 1))
    collided = np.zeros(3, bool)
    for _ in range(20):
        mine = ours.step(actions)[4]
        other = singles.step(actions.copy())[4]
        np.testing.assert_array_equal(mine["success"], other["success"])
        collided |= mine["collision"]
    assert mine["success"].tolist() == (~collided).tolist() == [False, False, True]


def test_no_nan_stops_programs_that_look_for_nans():
    envs = gym.make_vec(NAME + "dense-merge-v0", num_envs=3, config=DRIVING)
    envs.reset(seed=0)
    jax.config.update("jax_debug_nans", True)  # in all threads
    try:
        rewards = envs.step(np.zeros((3, 2), np.float32))[1]
    finally:
        jax.config.update("jax_debug_nans", False)
    assert np.isfinite(rewards).all()


def rewards_of_two_steps(scenario):
    """A function from the action of two steps to the sum of their rewards."""
    env = FunctionalEnv(scenario, {"action": {"type": "ContinuousAction"}})
    start, _ = env.reset(jax.random.key(0))

    def rewards(action):
        state, _, first, *_ = env.step(start, action)
        return first + env.step(state, action)[2]

    return rewards


@pytest.mark.slow
def test_reverse_derivatives_need_plans_of_fixed_length():
    rewards = rewards_of_two_steps("merger-v0")
    action = np.float32([0.1, 0.02])
    shifted = action + 0.01 * np.float32([[1, 0], [-1, 0], [0, 1], [0, -1]])
    earned = jax.jit(jax.vmap(rewards))(shifted)
    for derive in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(
            jax.jit(derive(rewards))(action),
            (earned[::2] - earned[1::2]) / 0.02,
            rtol=0.05,
        )
    rewards = rewards_of_two_steps("merger-v1")
    assert jax.eval_shape(jax.jacfwd(rewards), action).shape == (2,)
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        jax.eval_shape(jax.grad(rewards), action)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_episodes_begin_anew_as_gymnasium_says(mode):
    ours, singles = both("dense-merge-v0", DRIVING | {"duration": 0.3}, mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    ours.reset(seed=0), singles.reset(seed=0)
    for _ in range(8):
        actions = 1.5 * ours.action_space.sample()  # both clip them
        mine = ours.step(actions)
        other = singles.step(actions.copy())
        for part in range(4):
            np.testing.assert_allclose(mine[part], other[part], atol=1e-3)
        ended = mine[2] | mine[3]
        if mode is AutoresetMode.SAME_STEP and ended.any():
            np.testing.assert_allclose(
                np.stack(mine[4]["final_obs"]),
                np.stack(other[4]["final_obs"]),
                atol=1e-4,
            )
        if mode is AutoresetMode.DISABLED and ended.any():
            with pytest.raises(ValueError, match="reset before they can step"):
                ours.step(actions)
            mine, other = (
                envs.reset(options={"reset_mask": ended})[0] for envs in (ours, singles)
            )
            np.testing.assert_allclose(mine, other, atol=1e-5)


def test_jitted_and_vmapped_functions_equal_the_environment():
    config = CHOOSING | {"ladder": ["naive", "idm"]}
    env = FunctionalEnv("merger-v1", config)
    single = gym.make(NAME + "merger-v1", config=config)
    state, seen = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))
    assert np.abs(seen[0] - seen[1]).max() > 1e-4  # from keys of their own
    observation, _ = single.reset(
        options={"initial_states": np.asarray(state.now.state)[1, 0]}
    )
    step = jax.jit(jax.vmap(env.step))
    for action in (1, 1, 0, 1):
        np.testing.assert_allclose(seen[1], observation, atol=1e-4)
        state, seen, reward, terminated, truncated, info = step(
            state, np.array([0, action])
        )
        observation, wanted, *_ = single.step(action)
        assert float(reward[1]) == pytest.approx(wanted, abs=2e-3)
        assert not (terminated | truncated | info["collision"]).any()
    np.testing.assert_allclose(seen[..., -1], 36 / 40)  # of the time is left
    with pytest.raises(ValueError, match=r"shape \(1,\); give one of Discrete\(2\)"):
        env.step(state, np.array([2]))


def test_a_scenario_is_known_by_name_and_id():
    for name in ("merger", "merger-v0", "ms-highway/merger-v0", NAME + "merger-v0"):
        assert scenario_name(name) == "merger"
    assert scenario_name("stay_back-v0") == scenario_name("stay-back-v0") == "stay_back"
    for name in ("ms-highway/merger", "merger-v1-v0"):
        with pytest.raises(ValueError, match=f"unknown scenario '{name}'"):
            scenario_name(name)


def test_draws_that_jax_lacks_are_refused_with_the_known_ones():
    with pytest.raises(
        AttributeError,
        match="draws no 'exponential' here; draw by normal, uniform or beta",
    ):
        TracedRandom(jax.random.key(0)).exponential()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"action": {"type": "DiscreteAction"}}, "what is simulated is Autopilot"),
        (
            {"observation": {"type": "Kinematics"}},
            "what is simulated is CarStates or SceneStates",
        ),
        ({"costs": "measured"}, "cannot measure plans"),
    ],
)
def test_a_configuration_that_is_not_simulated_is_refused(config, message):
    with pytest.raises(ValueError, match=message):
        gym.make_vec(NAME + "merger-v1", num_envs=2, config=config)


def test_wrong_actions_seeds_and_masks_are_refused():
    env = gym.make_vec(NAME + "merger-v1", num_envs=2, config=CHOOSING)
    with pytest.raises(ValueError, match="3 seeds for 2 environments"):
        env.reset(seed=[0, 1, 2])
    for seed in (1.5, -1, "ab", [0, 0.5], [-1, 0], np.array(3)):
        with pytest.raises(
            ValueError,
            match=r"the seed of reset is .*; give a whole number from 0 on, or None",
        ):
            env.reset(seed=seed)
    with pytest.raises(
        ValueError,
        match="the reset options are 3; give a mapping with keys out of reset_mask",
    ):
        env.reset(options=3)
    for key in (3, None):
        with pytest.raises(
            ValueError,
            match=(
                rf"the key of reset is {key}; give one of JAX, such as jax\.random\.key"
            ),
        ):
            FunctionalEnv("merger-v1").reset(key)
    with pytest.raises(ValueError, match="never reset; reset all of them"):
        env.reset(options={"reset_mask": np.array([False, True])})
    with pytest.raises(ValueError, match=r"reset before they can step: \[0, 1\]"):
        env.step([0, 0])
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions array\(\[0, 2\]\) are impossible"):
        env.step([0, 2])
    with pytest.raises(ValueError, match="impossible"):
        env.step([0.9, 1.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(
            (
                {"num_envs": number},
                "num_envs is .*; give a whole number of environments",
            )
            for number in (0, -1, 1.5, "2")
        ),
        (
            {"autoreset_mode": "same"},
            "autoreset_mode is 'same'; give one of AutoresetMode.NEXT_STEP",
        ),
        (
            {"config": {"humans": 2}},
            r"config\['humans'\] is 2; merger-v1 has one human; leave it out",
        ),
    ],
)
def test_an_impossible_vector_environment_is_refused_when_it_is_made(
    arguments, message
):
    with pytest.raises(ValueError, match=message):
        gym.make_vec(NAME + "merger-v1", **{"num_envs": 2, **arguments})


@pytest.mark.parametrize(
    ("config", "action", "message"),
    [
        (CHOOSING, 2, r"action 2 is impossible; give one of Discrete\(2\)"),
        (
            CHOOSING,
            0.5,
            r"numbers of type float32; give one of Discrete\(2\), of whole numbers",
        ),
        (
            {"action": {"type": "ContinuousAction"}},
            [np.nan, 0.0],
            r"nan.* is impossible; give one of Box",
        ),
        (
            {"action": {"type": "ContinuousAction"}},
            [1.0, 0.0, 9.0, 9.0],
            r"shape \(4,\); give one of Box",
        ),
    ],
)
def test_pure_functions_refuse_impossible_actions(config, action, message):
    env = FunctionalEnv("merger-v1", config)
    with pytest.raises(ValueError, match=message):
        env.step(None, action)


def test_observations_tell_states_and_cones_within_bounds():
    env = gym.make(NAME + "stay-back-v1").unwrapped
    observation, _ = env.reset(seed=0)
    assert np.abs([env.observation_space.low, env.observation_space.high]).max() < 100
    robot, human = env.car_states
    x, y, _, speed = human - robot
    np.testing.assert_allclose(
        observation[1, :4], [1.0, x / 100, y / 10, speed / 40], atol=1e-4
    )  # present, and where
    cones = np.array([cone.position for cone in env.road.objects])
    ahead = cones[np.abs(cones[:, 1] - robot[1]) < 5 / 3, 0].min()
    bodies = (env.robot.LENGTH + env.road.objects[0].LENGTH) / 2
    assert observation[0, 7] == pytest.approx(
        (ahead - robot[0] - bodies) / 100, abs=1e-5
    )
