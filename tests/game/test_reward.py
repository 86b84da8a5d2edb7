"""Features and rewards."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.features import features, reward
from ms_highway.game.game import swap_players
from ms_highway.game.reward import FEATURES, RewardModel, linear_reward
from ms_highway.game.scenarios import MERGER
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.jax_settings import double_precision

NARROW = replace(MERGER, cones=((0.0, 2.0),))
features_of = jit_quickly(features)


def test_features_do_not_depend_on_the_unit_of_length(played):
    game, state = played(NARROW)
    same, in_units = played(NARROW, unit=1.0)
    found = features_of(game.scene, game.robot, state)
    found_in_units = features_of(same.scene, same.robot, in_units)
    np.testing.assert_allclose(found_in_units, found, rtol=2e-4, atol=1e-6)


def test_rewards_are_linear_in_features_in_every_batch_shape(played):
    game, state = played(NARROW)
    found = np.asarray(features_of(game.scene, game.robot, state))
    states = np.tile(state, (2, 1, 1, 1))
    earned = jit_quickly(reward)(game.scene, game.robot, states)
    expected = np.full((2, 1), found @ game.robot.weights)
    np.testing.assert_allclose(earned, expected, rtol=1e-6)


def test_the_slope_of_every_feature_equals_differences(played):
    """Indicators have no slope.

    In double precision, for four cars close to each other at the left edge of the road,
    behind a leader.
    """
    game, state = played("merger", humans=2, unit=1.0)
    driver = linear_reward(dict.fromkeys(FEATURES, 1.0), 0.6)
    random = np.random.default_rng(0)
    states = np.asarray(state, float) + random.normal(
        0, [0.1, 0.03, 0.1, 0.1], (6, *state.shape)
    )
    steps = 1e-6 * np.eye(states[0].size).reshape(-1, *states[0].shape)
    with double_precision():
        scene, driver = jax.tree.map(
            partial(jnp.asarray, dtype=jnp.float64), (game.scene, driver)
        )

        def slopes_and_differences(state):
            slopes = jax.jacrev(features, argnums=2)(scene, driver, state)
            after = features(scene, driver, state + steps)
            before = features(scene, driver, state - steps)
            return slopes.reshape(len(FEATURES), -1), (after - before).T / 2e-6

        both = jax.device_get(
            jax.jit(jax.vmap(slopes_and_differences, out_axes=1))(states)
        )
    for name, slopes, wanted in zip(FEATURES, *both, strict=True):
        if name in RewardModel.indicators:
            assert not slopes.any(), name
        else:
            assert abs(wanted).max() > 0, name
            np.testing.assert_allclose(
                slopes, wanted, atol=1e-5 * abs(wanted).max(), err_msg=name
            )


def test_each_human_sees_the_game_from_its_own_side(played):
    game, state = played("merger", humans=2)
    weights = game.humans.weights * np.float32([[1], [2]])
    game = replace(game, humans=replace(game.humans, weights=weights))
    swap = jax.jit(swap_players)
    for human, order in enumerate(([1, 0, 2, 3], [2, 0, 1, 3])):
        alone, own = swap(game, state, human)
        np.testing.assert_array_equal(own, np.asarray(state)[order])
        np.testing.assert_array_equal(alone.robot.weights, game.humans.weights[human])
        again, back = swap_players(alone, own)
        np.testing.assert_array_equal(back[:2], np.asarray(state)[[0, 1 + human]])
        np.testing.assert_array_equal(again.robot.weights, game.robot.weights)
        np.testing.assert_array_equal(
            again.humans.weights, game.humans.weights[[human]]
        )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contact": "body"}, "Scene.contact is 'body'; give one of paper, bodies"),
        (
            {"car_size": np.array([5.0, np.nan])},
            r"Scene.car_size is \[.*; give .* in metres",
        ),
        (
            {"obstacles": np.array([1.0, 2.0])},
            r"obstacles is \[1.0, 2.0\]; give an array \[n, 2\]",
        ),
    ],
)
def test_a_scene_of_impossible_numbers_or_shapes_is_refused(played, changes, message):
    game, _ = played("merger")
    with pytest.raises(ValueError, match=message):
        replace(game.scene, **changes)
    assert isinstance(replace(game.scene, lanes=[0.0, 4.0]).lanes, np.ndarray)
