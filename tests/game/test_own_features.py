"""User-defined features in rewards, plans and decisions."""

import pickle
from dataclasses import replace

import gymnasium as gym
import jax
import numpy as np
import pytest
from episodes import drive, make
from jax import numpy as jnp

from ms_highway.choice.quadratic import expand
from ms_highway.envs import environment_id
from ms_highway.experiments.batch import simulated
from ms_highway.experiments.comparison import Comparison
from ms_highway.game.features import features
from ms_highway.game.game import total_reward
from ms_highway.game.reward import (
    PAPER_FEATURES,
    USER_FEATURES,
    add_feature,
    linear_reward,
    weight_names,
)
from ms_highway.game.scenario import build_game, driving_game
from ms_highway.game.scenarios import MERGER
from ms_highway.planning.compiled_plans import plan
from ms_highway.runtime.compilation import jit_quickly


def room(scene, own, others):
    """A soft minimum of the squared distances to cars and cones, in length units."""
    x = jnp.concatenate([others.x, scene.obstacles[:, 0]])
    y = jnp.concatenate([others.y, scene.obstacles[:, 1]])
    squares = ((own.x - x) ** 2 + (own.y - y) ** 2) / scene.length_unit**2
    return -jnp.log(jnp.sum(jnp.exp(-squares)))


@pytest.fixture(autouse=True)
def roomy():
    """Merger with a cone beside the road, and a robot that likes to have room.

    The feature is removed after the test.
    """
    before = dict(USER_FEATURES)
    add_feature("room", room)
    weights = {**MERGER.robot_weights, "room": 30.0}
    yield build_game(replace(MERGER, cones=((0.4, 0.08),), robot_weights=weights))
    USER_FEATURES.clear()
    USER_FEATURES.update(before)


def test_decisions_expand_a_feature_of_all_cars_at_once(roomy, played):
    """Expansions neglect other cars and cones in the package's features alone."""
    state = np.array(played("merger")[1])
    state[0, 0] -= 3.0  # close to each other
    gradient = jit_quickly(
        jax.grad(lambda both: total_reward(roomy, state, both[0], both[1:]))
    )

    def slope(both):
        return np.asarray(gradient(both))

    both = np.random.default_rng(0).normal(0, 0.3, (2, 1, 2)).astype(np.float32)
    changes = 1e-2 * np.eye(4, dtype=np.float32).reshape(4, 2, 1, 2)
    bend = (
        np.stack(
            [slope(both + change) - slope(both - change) for change in changes]
        ).reshape(2, 2, 2, 2)
        / 2e-2
    )
    expansion = jit_quickly(expand)(roomy, state, both[0, 0], both[1, 0])
    close(expansion.gradient.reshape(2, 2), slope(both)[:, 0], 1e-3)
    hessian = np.asarray(expansion.hessian).reshape(bend.shape)
    for own, partner in ((0, 0), (0, 1), (1, 1)):
        close(hessian[own, :, partner], bend[own, :, partner], 5e-3)


def close(found, expected, tolerance):
    np.testing.assert_allclose(
        found, expected, atol=tolerance * np.abs(expected).max(), rtol=0
    )


def test_a_feature_that_is_added_again_is_computed_anew(played):
    game, state = played("merger")
    accelerations = []
    for sign in (1.0, -1.0):
        add_feature("haste", lambda scene, own, others, sign=sign: sign * own.speed)
        plays = driving_game(game.scene, 20.0, {"haste": 1.0, "lane_alignment": 1.0})
        accelerations.append(plan(plays, state, "naive").robot[0, 1])
    faster, slower = accelerations
    assert slower < 0 < faster


def test_a_feature_sees_one_moment_at_a_time(played):
    game, state = played("merger")
    add_feature(
        "nearby", lambda scene, own, others: jnp.max(others.x) > own.x
    )  # over cars, not over times
    ahead = np.linspace(-40.0, 40.0, 6).reshape(2, 3)
    states = np.tile(state, (2, 3, 1, 1))
    states[..., 0, 0] = ahead
    found = jit_quickly(features)(
        game.scene, linear_reward({"nearby": 3.0}, 20.0), states
    )[..., -1]
    np.testing.assert_array_equal(found, ahead < float(state[1:, 0].max()))


def speed(scene, own, others):
    return own.speed


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        ("speed", speed, "cannot be called 'speed'; choose one word other than"),
        (
            "own",
            lambda scene, own, others: others.speed,
            r"'own' returns float32 of shape \(3,\) .* must return one",
        ),
        (
            "own",
            lambda scene, own, others: float(own.speed),
            "'own' cannot be computed: Concretization.* jax.numpy",
        ),
    ],
)
def test_taken_names_and_unusable_functions_are_refused(name, function, message):
    before = weight_names()
    with pytest.raises(ValueError, match=message):
        add_feature(name, function)
    assert weight_names() == before


BROKEN = {
    "nowhere": (
        lambda scene, own, others: jnp.log(-1.0 - own.speed**2),
        "is nan; return a finite number",
    ),
    "endless": (
        lambda scene, own, others: own.speed / (0.0 * own.x),
        "is -?inf; return a finite number",
    ),
    "edgy": (
        lambda scene, own, others: jnp.sqrt(jnp.maximum(-own.speed, 0.0)),
        "has a gradient that is not finite",
    ),
    "later": (
        lambda scene, own, others: jnp.where(own.x > 15.0, jnp.nan, own.speed),
        "of car 0 in the state .* is nan; return a finite number",
    ),
}


@pytest.mark.parametrize("loop", ["live", "agent", "batch", "vector", "one plan"])
@pytest.mark.parametrize("name", BROKEN)
def test_a_feature_that_is_not_finite_is_named(name, loop):
    function, message = BROKEN[name]
    start = np.array(
        [[-4.0, 0.0, 0.0, 20.0], [-7.0, -3.3, 0.0, 20.0], [2.0, -3.3, 0.0, 20.0]]
    )
    add_feature(name, function)
    config = {
        "human_reward": {"speed": 2.0, "lane_alignment": 75.0, name: 1e-3},
        "ladder": ["naive"],
    }
    runs = {
        "live": lambda: drive(make("merger-v1", **config)),
        "agent": lambda: step_all(
            make("merger-v1", action={"type": "ContinuousAction"}, **config),
            np.zeros(2),
        ),
        "batch": lambda: simulated(
            Comparison({"merger-v1": ["naive"]}, seeds=1, config=config)
        ),
        "vector": lambda: step_all(
            gym.make_vec(
                environment_id("merger-v1"), 2, config={"controller": "naive", **config}
            ),
            np.zeros(2, int),
        ),
        "one plan": lambda: plan(
            make("merger-v1", **config).unwrapped.game, start, "naive"
        ),
    }
    if (name, loop) == ("later", "one plan"):
        runs[loop]()  # where nothing is wrong
        return
    with pytest.raises(ValueError, match=f"the feature '{name}' .*{message}"):
        runs[loop]()


def step_all(envs, actions):
    envs.reset(seed=0)
    for _ in range(39):
        envs.step(actions.copy())


def test_weights_of_unknown_or_left_out_features_are_refused():
    with pytest.raises(
        ValueError,
        match=r"unknown reward features \['rom'\].*room.*--import the module that does",
    ):
        linear_reward({"rom": 1.0}, 20.0)
    with pytest.raises(
        ValueError, match="room would not be computed; add them to the names"
    ):
        linear_reward({"room": 1.0}, 20.0, names=PAPER_FEATURES)


def test_a_game_with_a_user_defined_feature_is_pickled(roomy):
    again = pickle.loads(pickle.dumps(roomy))
    assert jax.tree.structure(again) == jax.tree.structure(roomy)
