"""Features and rewards."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.game.features import features, reward
from ms_highway.game.game import pair, swap_players, total_reward
from ms_highway.game.reward import PAPER_FEATURES, linear_reward
from ms_highway.runtime.compilation import jit_quickly

INDICATORS = ["collision", "merged", "partner_merged"]


compiled, earned = jit_quickly(features), jit_quickly(reward)
slopes = jit_quickly(jax.jacrev(features, argnums=2))


def feature(name, game, state):
    return float(compiled(game.scene, game.robot, jnp.asarray(state))[PAPER_FEATURES.index(name)])


@pytest.mark.parametrize("batch", [(), (3,), (2, 1)])
def test_features_take_every_batch_shape(scenario, played, batch):
    game, state = played(scenario)
    states = jnp.broadcast_to(state, (*batch, *state.shape))
    assert compiled(game.scene, game.robot, states).shape == (*batch, len(PAPER_FEATURES))
    expected = np.full(batch, earned(game.scene, game.robot, state))
    np.testing.assert_allclose(earned(game.scene, game.robot, states), expected, rtol=1e-6)


def test_features_do_not_depend_on_the_unit_of_length(scenario, played):
    in_metres = played(scenario)
    in_paper_units = played(scenario, unit=1.0)
    np.testing.assert_allclose(
        *(compiled(game.scene, game.robot, state) for game, state in (in_metres, in_paper_units)), rtol=2e-4, atol=1e-6
    )


@pytest.mark.parametrize(("scenario", "humans"), [("stay_back", 1), ("merger", 2)])
def test_gradients_agree_with_finite_differences(played, scenario, humans):
    game, state = played(scenario, unit=1.0, humans=humans)
    with jax.enable_x64(True):
        game, state = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.float64), (game, state))
        point, along = np.random.default_rng(0).normal(0, 0.3, (2, 1 + humans, 5, 2))

        def earned(controls):
            return total_reward(game, state, controls[0], controls[1:])

        def derivatives(controls):
            return earned(controls), *jax.jvp(jax.grad(earned), (controls,), (jnp.asarray(along),))

        points = point - 1e-5 * along, point, point + 1e-5 * along
        before, (_, slope, bend), after = jax.device_get(list(map(jax.jit(derivatives), points)))
    assert (after[0] - before[0]) / 2e-5 == pytest.approx(np.sum(slope * along), rel=1e-6)
    np.testing.assert_allclose((after[1] - before[1]) / 2e-5, bend, atol=1e-6 * abs(bend).max())


def test_the_reward_is_highest_at_the_speed_limit(played):
    game, state = played("merger")
    speeds = [feature("speed", game, state.at[0, 3].set(speed)) for speed in (10.0, 20.0, 30.0)]
    assert speeds == pytest.approx([0.75, 1.0, 0.75], abs=1e-3)


def test_a_collision_is_seen_with_cars_and_with_cones(played):
    game, state = played("stay_back")
    assert feature("collision", game, state) == 0
    assert feature("collision", game, state.at[0, :2].set(state[1, :2] + 1)) == 1
    assert feature("collision", game, state.at[0, :2].set(game.scene.obstacles[3])) == 1


def test_risk_grows_as_another_car_comes_closer(played):
    game, state = played("stay_back")
    risks = [
        feature("collision_risk", game, state.at[0, :2].set(state[1, :2] - jnp.array([gap, 0]))) for gap in (20, 9, 7)
    ]
    assert risks[0] < 1e-6 < risks[1] < risks[2]


def test_leaving_the_road_costs_the_square_of_the_depth(played):
    game, state = played("merger")
    unit, edge = 100 / 3, 0.05 * 100 / 3
    on_edge = state.at[0, 1:3].set(jnp.array([edge - 1.25, 0.0]))
    assert feature("off_road", game, on_edge) == pytest.approx(0, abs=1e-9)
    assert feature("off_road", game, on_edge.at[0, 1].add(0.5)) == pytest.approx((0.5 / unit) ** 2, rel=1e-3)


def test_a_car_has_merged_when_it_is_inside_the_target_lane(played):
    game, state = played("merger")
    border = -0.05 * 100 / 3
    assert feature("merged", game, state.at[0, 1:3].set(jnp.array([border + 0.1, 0.0]))) == 0
    assert feature("merged", game, state.at[0, 1:3].set(jnp.array([border - 0.1, 0.0]))) == 1
    assert feature("partner_merged", game, state) == 1


@pytest.mark.parametrize("name", INDICATORS)
def test_indicators_have_no_gradient(played, name):
    game, state = played("give_way")
    np.testing.assert_array_equal(slopes(game.scene, game.robot, state)[PAPER_FEATURES.index(name)], 0 * state)


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


def test_an_unknown_feature_is_refused_by_name():
    with pytest.raises(ValueError, match="sped"):
        linear_reward({"sped": 1.0}, 20.0)


@pytest.mark.parametrize("size", [[0.0, 2.5], [5.0, np.nan], [-5.0, 2.5], [np.inf, 2.5]])
def test_cars_without_a_size_are_refused(played, size):
    game, _ = played("merger")
    with pytest.raises(ValueError, match=r"Scene.car_size is \[.*; give .* in metres"):
        replace(game.scene, car_size=np.array(size))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"car_size": (0, 0)}, r"car_size is \[0.0, 0.0\]; give length and width"),
        ({"car_size": np.array([5.0])}, r"car_size is \[5.0\]; give an array \[2\]"),
        ({"lanes": [np.nan]}, r"lanes is \[nan\]; give an array \[n\]"),
        ({"obstacles": np.array([1.0, 2.0])}, r"obstacles is \[1.0, 2.0\]; give an array \[n, 2\]"),
        ({"lane_width": -1.0}, "lane_width is -1.0"),
    ],
)
def test_a_scene_of_impossible_numbers_or_shapes_is_refused(played, changes, message):
    game, _ = played("merger")
    with pytest.raises(ValueError, match=message):
        replace(game.scene, **changes)
    assert isinstance(replace(game.scene, lanes=[0.0, 4.0]).lanes, np.ndarray)
