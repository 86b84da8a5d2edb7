"""Scenarios with several humans: their geometry, what they drive for, and where they start."""

import numpy as np
import pytest

from ms_highway.game.crowd_scenario import (
    CARELESS,
    CARELESS_FACTOR,
    CROSSING_CROWD,
    DENSE_MERGE,
    HUMANS,
    SPACING,
    crowd_game,
    draw_crowd,
)
from ms_highway.game.learned_reward import shipped
from ms_highway.game.scenario import GRIP

SCENARIOS = [DENSE_MERGE, CROSSING_CROWD]
EPISODES = 60


def draws(scenario, humans):
    random = np.random.default_rng(0)
    return [draw_crowd(scenario, humans, random) for _ in range(EPISODES)]


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
    driver = crowd_game(DENSE_MERGE, 8).game.human
    risk = driver.names.index("collision_risk")
    weights = np.concatenate([weights for _, weights in draws(DENSE_MERGE, 8)])
    factors = weights[:, risk] / driver.weights[risk]
    np.testing.assert_array_equal(np.delete(weights, risk, 1), np.delete(np.tile(driver.weights, (480, 1)), risk, 1))
    careless = np.isclose(factors, CARELESS_FACTOR)
    assert careless.mean() == pytest.approx(CARELESS, abs=0.05)
    assert np.log(factors[~careless]).mean() == pytest.approx(0.0, abs=0.1)
    assert np.log(factors[~careless]).std() == pytest.approx(0.7, abs=0.1)


def test_by_default_everybody_drives_for_the_learned_reward_more_boldly_in_dense_traffic():
    crowd = crowd_game(DENSE_MERGE, 3)
    learned = shipped("demonstrations").weights
    assert crowd.humans == 3
    for name, weight in zip(crowd.game.human.names, crowd.weights.T, strict=True):
        caution = DENSE_MERGE.caution if name == "collision_risk" else 1.0
        np.testing.assert_allclose(weight, np.float32(caution * learned.get(name, 0.0)), rtol=1e-6)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_a_robot_that_brakes_at_once_stops_before_the_cones(scenario):
    game = crowd_game(scenario, 2).game
    front = float(game.scene.car_size[0] + game.scene.obstacle_size[0]) / 2
    room = float(game.scene.obstacles[:, 0].min()) - front
    stopping = 20.0**2 / (2 * GRIP)
    assert stopping + 5.0 < room < 5 * 20.0  # the cones are reached within 5 s


def test_weights_of_another_number_of_humans_are_refused():
    with pytest.raises(ValueError, match=r"shape \(2, 10\); 3 humans need \(3, 10\)"):
        crowd_game(DENSE_MERGE, 3, np.ones((2, 10), np.float32))
