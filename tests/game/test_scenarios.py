"""Scenarios: starts in streams, and the weights of humans."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from ms_highway.data.learned_reward import shipped
from ms_highway.envs import ENVIRONMENTS, InteractionEnv, add_scenario
from ms_highway.game.scenario import Scenario, build_game
from ms_highway.game.scenarios import CROSSING_CROWD, DENSE_MERGE, MERGER
from ms_highway.game.starts import STREAM_VARIETY, draw_episode

EPISODES = 60
LEARNED = shipped("demonstrations").weights


def draws(scenario, humans):
    random = np.random.default_rng(0)
    game = build_game(scenario, humans=humans, human_driving=LEARNED)
    return [draw_episode(scenario, random, game.humans) for _ in range(EPISODES)]


@pytest.mark.parametrize("humans", Scenario.humans_with_streams)
@pytest.mark.parametrize(
    "scenario", [DENSE_MERGE, CROSSING_CROWD], ids=lambda scenario: scenario.name
)
def test_streams_start_densely_with_the_robot_beside_their_middle(scenario, humans):
    shortest, longest = scenario.streams[0].spacing
    for starts, _ in draws(scenario, humans):
        assert starts.shape == (1 + humans, 4)
        assert abs(starts[0, :2]).max() < 0.1
        lanes = np.round(starts[1:, 1])
        assert len(set(lanes)) == len(scenario.streams)
        for lane in set(lanes):
            x = starts[1:][lanes == lane, 0]
            gaps = -np.diff(x)
            assert ((gaps > shortest - 0.2) & (gaps < longest + 0.2)).all()
            assert abs((x > 0).sum() - len(x) / 2) <= 1


def test_humans_in_streams_differ_only_in_how_readily_they_yield():
    game = build_game(DENSE_MERGE, human_driving=LEARNED)
    assert game.number == 8
    believed = game.humans.weights
    risk = game.humans.names.index("collision_risk")
    weights = np.concatenate([weights for _, weights in draws(DENSE_MERGE, 8)])
    expected = np.tile(believed, (EPISODES, 1))
    np.testing.assert_array_equal(
        np.delete(weights, risk, 1), np.delete(expected, risk, 1)
    )
    factors = weights[:, risk] / expected[:, risk]
    careless = np.isclose(factors, STREAM_VARIETY.careless_factor)
    assert careless.mean() == pytest.approx(DENSE_MERGE.careless, abs=0.05)
    assert np.log(factors[~careless]).mean() == pytest.approx(0.0, abs=0.1)
    assert np.log(factors[~careless]).std() == pytest.approx(0.7, abs=0.1)


@pytest.mark.parametrize("scenario", [MERGER, DENSE_MERGE])
def test_humans_combine_given_weights_with_aims_and_caution(
    scenario,
):
    game = build_game(scenario, human_driving=LEARNED)
    aims = {"target_lane": 1000, "gap": 70} if scenario.name == "merger" else {}
    for name, weights in zip(game.humans.names, game.humans.weights.T, strict=True):
        caution = scenario.caution if name == "collision_risk" else 1.0
        np.testing.assert_allclose(
            weights, caution * {**aims, **LEARNED}.get(name, 0.0), rtol=1e-6
        )


@pytest.mark.parametrize(
    ("numbers", "told"),
    [
        ({"lanes": (-0.1, 0.0)}, r"lanes at \(-0.1, 0.0\).*2.5 to 6 m apart.*metres"),
        ({"humans": 2}, "humans=2 and 0 streams; streams say where"),
    ],
)
def test_impossible_scenarios_are_refused(numbers, told):
    with pytest.raises(ValueError, match=f"scenario 'merger' has {told}"):
        replace(MERGER, **numbers)


WRONG = {
    "no human": (
        {"cars": MERGER.cars[:1]},
        "has no human, as its cars are .*give the starts of the robot and of the",
    ),
    "humans": (
        {"humans": 0},
        (
            "has humans=0 and 0 streams; streams say where .*, and without streams"
            " there is one"
        ),
    ),
    "weight": (
        {"robot_weights": {"sped": 2}},
        r"robot_weights: unknown reward features \['sped'\]; the features are",
    ),
    "infinite": (
        {"human_weights": {"speed": np.inf}},
        "human_weights: the weight of speed is inf; it must be a fin",
    ),
    "no weights": (
        {"human_weights": ["speed"]},
        r"has human_weights=\['speed'\]; give weights by name",
    ),
    "model": (
        {"ladder": ("naive", "tomm")},
        r"has the ladder .*: unknown human model 'tomm'; the models are naive",
    ),
    "order": (
        {"ladder": ("tom", "naive")},
        "has the ladder .*: impossible ladder .*name each model once, cheapest",
    ),
    "no model": ({"ladder": ()}, r"has the ladder \(\): impossible ladder"),
    "steps": ({"steps": 0}, "has steps=0; give a whole number of steps, 1 or more"),
    "price": ({"prices": (1.0,)}, r"has the prices \(1.0,\); give two lambdas"),
    "prices of texts": ({"prices": ("a", "b")}, "has the prices .*; give two lambdas"),
    "car": (
        {"merging_car": 7},
        "has merging_car=7; give the place of one of its 3 cars",
    ),
    "point": (
        {"cars": ((0.0,), *MERGER.cars[1:])},
        r"has a car at \(0.0,\); give x and y",
    ),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_a_scenario_that_cannot_be_driven_is_not_added(changes, message):
    before = list(gymnasium.registry)
    with pytest.raises(ValueError, match=f"scenario 'mine'.*{message}"):
        add_scenario(
            type(
                "MineEnv",
                (InteractionEnv,),
                {"scenario": replace(MERGER, name="mine", **changes)},
            )
        )
    assert "mine" not in ENVIRONMENTS
    assert list(gymnasium.registry) == before


def test_only_a_class_of_environments_with_a_scenario_is_added():
    for wrong, message in (
        (
            MERGER,
            (
                "is no class of environments; give a class derived from"
                " ms_highway.InteractionEnv"
            ),
        ),
        (
            type("NoneEnv", (InteractionEnv,), {"scenario": None}),
            "`scenario` of NoneEnv is None; make it a ms_highway.Sc",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            add_scenario(wrong)
