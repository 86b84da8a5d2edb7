"""Features and rewards."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.features import features, reward
from ms_highway.game.game import pair, swap_players
from ms_highway.game.reward import FEATURES, NO_GRADIENT, PAPER_FEATURES, linear_reward
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.jax_settings import double_precision

compiled, earned = jit_quickly(features), jit_quickly(reward)


def test_features_take_every_batch_shape(played):
    game, state = played("merger")
    expected = earned(game.scene, game.robot, state)
    for batch in ((), (2, 1)):
        states = jnp.broadcast_to(state, (*batch, *state.shape))
        assert compiled(game.scene, game.robot, states).shape == (*batch, len(PAPER_FEATURES))
        np.testing.assert_allclose(earned(game.scene, game.robot, states), np.full(batch, expected), rtol=1e-6)


@pytest.mark.parametrize("scenario", ["stay_back", "merger"])
def test_features_do_not_depend_on_the_unit_of_length(scenario, played):
    games = played(scenario), played(scenario, unit=1.0)
    in_metres, in_units = (compiled(game.scene, game.robot, state) for game, state in games)
    np.testing.assert_allclose(in_metres, in_units, rtol=2e-4, atol=1e-6)


def test_the_slope_of_every_feature_equals_differences_and_indicators_have_none(played):
    """In double precision, for four cars close to each other at the left edge of the road, behind a leader."""
    game, state = played("merger", humans=2, unit=1.0)
    driver = linear_reward(dict.fromkeys(FEATURES, 1.0), 0.6)
    random = np.random.default_rng(0)
    states = np.asarray(state, float) + random.normal(0, [0.1, 0.03, 0.1, 0.1], (6, *state.shape))
    steps = 1e-6 * np.eye(states[0].size).reshape(-1, *states[0].shape)
    with double_precision():
        scene, driver = jax.tree.map(partial(jnp.asarray, dtype=jnp.float64), (game.scene, driver))

        def found_and_expected(state):
            both = [features(scene, driver, state + sign * steps) for sign in (1, -1)]
            return jax.jacrev(features, argnums=2)(scene, driver, state).reshape(len(FEATURES), -1), both

        found, (after, before) = jax.device_get(jax.jit(jax.vmap(found_and_expected))(states))
    expected = np.moveaxis(after - before, 1, 2) / 2e-6
    for name, slopes, wanted in zip(FEATURES, np.moveaxis(found, 1, 0), np.moveaxis(expected, 1, 0), strict=True):
        if name in NO_GRADIENT:
            assert not slopes.any(), name
        else:
            assert abs(wanted).max() > 0, name
            np.testing.assert_allclose(slopes, wanted, atol=1e-5 * abs(wanted).max(), err_msg=name)


@pytest.mark.parametrize(("human", "order"), [(0, [1, 0, 2, 3]), (1, [2, 0, 1, 3])])
def test_each_human_sees_the_game_from_its_own_side(played, human, order):
    game, state = played("merger", humans=2)
    game = replace(game, humans=replace(game.humans, weights=game.humans.weights * np.float32([[1], [2]])))
    alone, own = swap_players(game, state, human)
    np.testing.assert_array_equal(own, state[np.array(order)])
    np.testing.assert_array_equal(alone.robot.weights, game.humans.weights[human])
    again, back = swap_players(alone, own)
    np.testing.assert_array_equal(back[:2], state[np.array([0, 1 + human])])
    np.testing.assert_array_equal(again.robot.weights, game.robot.weights)
    np.testing.assert_array_equal(*(each.humans.weights[0] for each in (again, pair(game, state, human)[0])))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"car_size": np.array([5.0, np.nan])}, r"Scene.car_size is \[.*; give .* in metres"),
        ({"obstacles": np.array([1.0, 2.0])}, r"obstacles is \[1.0, 2.0\]; give an array \[n, 2\]"),
        ({"lane_width": -1.0}, "lane_width is -1.0"),
    ],
)
def test_a_scene_of_impossible_numbers_or_shapes_is_refused(played, changes, message):
    game, _ = played("merger")
    with pytest.raises(ValueError, match=message):
        replace(game.scene, **changes)
    assert isinstance(replace(game.scene, lanes=[0.0, 4.0]).lanes, np.ndarray)
