"""Scenarios with several humans: their geometry, what they drive for, and where they start."""

import numpy as np
import pytest

from ms_highway.game.scenario import CARELESS, CARELESS_FACTOR, GRIP, HUMANS, SPACING, build_game, draw_episode
from ms_highway.game.scenarios import CROSSING_CROWD, DENSE_MERGE

SCENARIOS = [DENSE_MERGE, CROSSING_CROWD]
EPISODES = 60


def draws(scenario, humans):
    random = np.random.default_rng(0)
    rewards = build_game(scenario, humans=humans).humans
    return [draw_episode(scenario, random, rewards) for _ in range(EPISODES)]


@pytest.mark.parametrize("humans", [HUMANS[0], 5, HUMANS[1]])
@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_humans_start_in_streams_of_short_spacings_with_the_robot_beside_their_middle(scenario, humans):
    shortest, longest = SPACING
    for starts, _ in draws(scenario, humans):
        assert starts.shape == (1 + humans, 4)
        assert abs(starts[0, :2]).max() < 0.1
        lanes = np.round(starts[1:, 1], 0)
        assert len(set(lanes)) == len(scenario.streams)
        for lane in set(lanes):
            x = starts[1:][lanes == lane, 0]
            gaps = -np.diff(x)
            assert ((gaps > shortest - 0.2) & (gaps < longest + 0.2)).all()
            assert abs((x > 0).sum() - len(x) / 2) <= 1


def test_most_gaps_are_too_short_for_a_car_unless_somebody_yields():
    gaps = np.concatenate([-np.diff(starts[1:, 0]) for starts, _ in draws(DENSE_MERGE, 8)])
    car_length = 5.0
    assert np.mean(gaps < 2 * car_length) > 0.9


def test_humans_differ_in_how_readily_they_yield_and_in_nothing_else():
    driver = build_game(DENSE_MERGE).human()
    risk = driver.names.index("collision_risk")
    weights = np.concatenate([weights for _, weights in draws(DENSE_MERGE, 8)])
    factors = weights[:, risk] / driver.weights[risk]
    np.testing.assert_array_equal(np.delete(weights, risk, 1), np.delete(np.tile(driver.weights, (480, 1)), risk, 1))
    careless = np.isclose(factors, CARELESS_FACTOR)
    assert careless.mean() == pytest.approx(CARELESS, abs=0.05)
    assert np.log(factors[~careless]).mean() == pytest.approx(0.0, abs=0.1)
    assert np.log(factors[~careless]).std() == pytest.approx(0.7, abs=0.1)


def test_all_are_believed_to_drive_for_the_reward_given_more_boldly_in_dense_traffic():
    driving = {"speed": 3.0, "collision_risk": -2.0}
    game = build_game(DENSE_MERGE, human_driving=driving, humans=3)
    assert game.number == 3
    for name, weights in zip(game.humans.names, game.humans.weights.T, strict=True):
        caution = DENSE_MERGE.caution if name == "collision_risk" else 1.0
        np.testing.assert_allclose(weights, np.float32(caution * driving.get(name, 0.0)), rtol=1e-6)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_a_robot_that_brakes_at_once_stops_before_the_cones(scenario):
    game = build_game(scenario)
    front = float(game.scene.car_size[0] + game.scene.obstacle_size[0]) / 2
    room = float(game.scene.obstacles[:, 0].min()) - front
    stopping = 20.0**2 / (2 * GRIP)
    assert stopping + 5.0 < room < 5 * 20.0  # the cones are reached within 5 s
