"""Learned values of computation: their inputs, their choices and their files."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from episodes import drive, make

from ms_highway.choice.learned_value import LearnedValue, load_values, save_values
from ms_highway.choice.rule import Outcome, decide, first_memory
from ms_highway.choice.situation import describe, description_names
from ms_highway.envs import ENVIRONMENTS, SCENARIOS
from ms_highway.game.scenario import PAPER_UNIT, build_game
from ms_highway.game.starts import draw_episode
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.ladders import ladder
from ms_highway.planning.plans import Plan

describe_quickly = jax.jit(describe)
decide_quickly = jax.jit(decide)
SHIPPED = load_values("shipped")
LADDER = ladder(("naive", "turn", "tom"))
SECONDS = np.array([0.0, 0.0006, 0.002], np.float32)  # over naive
INPUTS = len(description_names())


@pytest.mark.parametrize("name", ["stay_back", "dense_merge"])
def test_a_description_depends_neither_on_units_nor_on_places_and_keeps_the_order_of_the_humans(name):
    scenario = SCENARIOS[name]
    game, small = build_game(scenario), build_game(scenario, unit=1.0)
    start, _ = draw_episode(scenario, np.random.default_rng(1), small.humans)
    start[:, 2] += 0.02
    metres, far = start * [PAPER_UNIT, PAPER_UNIT, 1, PAPER_UNIT], np.array([50.0, 0, 0, 0])
    described = describe_quickly(game, metres)
    assert described.shape == (game.number, INPUTS)
    np.testing.assert_allclose(describe_quickly(small, start), described, rtol=1e-3, atol=2e-3)
    moved = replace(game, scene=replace(game.scene, obstacles=game.scene.obstacles + far[:2]))
    further = describe_quickly(moved, metres + far)
    np.testing.assert_allclose(further, described, rtol=1e-2, atol=2e-2)  # float32 loses digits further out
    turned = metres[[0, *range(game.number, 0, -1)]]
    np.testing.assert_allclose(describe_quickly(game, turned)[::-1], described, rtol=1e-4, atol=1e-4)


def test_the_model_with_the_highest_gain_plans_and_theory_of_mind_is_used_at_the_start_only():
    models = ["naive"]  # the first rung, to which the first gains are compared
    for info in drive(make("merger", "learned:1")).infos:
        gains = {models[-1]: 0.0} | info["gains"]
        models.append(info["model"])
        assert max(gains, key=gains.get) == models[-1]
    assert (models[1], models[-1]) == ("tom", "naive")  # Algorithm 1 starts with naive
    assert 2 <= models.count("tom") <= 20


@pytest.fixture
def file(tmp_path):
    save_values(SHIPPED, tmp_path / "values.npz")
    return tmp_path / "values.npz"


def test_a_file_is_read_as_it_was_written(file):
    read = load_values(file)
    jax.tree.map(np.testing.assert_array_equal, read.network, SHIPPED.network)
    assert read.provenance == SHIPPED.provenance


def about(**changes):
    return lambda written: np.array(json.dumps(json.loads(str(written)) | changes))


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        ("about", about(version=99), "version 99"),
        ("about", about(ladder=["naive", "naive", "tom"]), "each once"),
        ("weights_2", lambda weights: weights * 1e9, "weights of the networks are beyond 1000"),
        ("biases_1", lambda biases: biases[:1], "shapes"),
    ],
)
def test_the_refusal_of_a_damaged_file_names_the_damage_and_the_command_that_writes_another(
    file, name, change, problem
):
    with np.load(file) as archive:
        arrays = dict(archive)
    np.savez(file, **arrays | {name: change(arrays[name])})
    with pytest.raises(ValueError, match=rf"values\.npz cannot be read.*{problem}.*`ms-highway values learn` --out"):
        load_values(file)


@pytest.fixture(scope="module")
def decided(played):
    """Return a function that decides for two humans before the first step, with an error added to the state."""
    game, start = played("dense_merge")
    still = np.zeros((5, 2), np.float32)

    def decision(rule, error=0.0):
        outcome = Outcome(start, start + error, still[0], still[:2], 0.0, Plan(still, np.stack([still] * 2)))
        return decide_quickly(rule, game, first_memory(rule, 2), outcome)

    return decision


def test_a_shorter_ladder_has_the_gains_of_the_whole_ladder(decided):
    rules = (SHIPPED.rule(LADDER[:size], Costs(0.0, SECONDS[:size]), 10.0) for size in (3, 2))
    whole, part = (decided(replace(rule, cautious=False)).gains for rule in rules)
    np.testing.assert_allclose(whole[:, :2], part, rtol=1e-4)


def over_naive(gains, price=0.0, doubt=0.0):
    """Return a rule whose networks expect equal gains of turn and tom everywhere, and are less certain about tom."""
    expected = np.array([[*gains, 0, 0], [*gains, 0, 0]], np.float32)
    expected[:, 1] += np.array([doubt, -doubt])
    network = ((np.zeros((2, INPUTS, 4), np.float32), expected),)
    standard = np.zeros(INPUTS, np.float32), np.ones(INPUTS, np.float32)
    return LearnedValue(Costs(0.003, SECONDS), price, network, *standard, LADDER)


def test_higher_prices_of_planning_choose_cheaper_models(decided):
    for price, rung in ((0.0, 2), (500.0, 1), (5000.0, 0)):
        decision = decided(over_naive((0.5, 1.0), price))
        np.testing.assert_allclose(decision.gains, [np.array([0.0, 0.5, 1.0]) - price * SECONDS] * 2, atol=1e-6)
        assert decision.memory.rungs.tolist() == [rung] * 2


def test_a_ladder_of_one_rung_leaves_nothing_to_choose(decided):
    for cautious in (True, False):
        rule = replace(SHIPPED.rule(LADDER[:1], Costs(0.0, SECONDS[:1]), 10.0), cautious=cautious)
        assert decided(rule).memory.rungs.tolist() == [0, 0]


def test_shipped_values_among_several_humans_are_those_that_know_the_ladder():
    settings = ENVIRONMENTS["dense-merge-v1"]().settings
    start = settings.start({}, 1, np.random.default_rng())
    for names in (("naive", "tom"), ("naive", "turn", "tom")):
        assert settings.controller.learned(start._replace(ladder=ladder(names))).ladder == names


def test_doubtful_and_failed_estimates_choose_the_cheapest_rung(decided):
    certain, doubtful = over_naive((0.0, 0.1)), over_naive((0.0, 0.1), doubt=1.0)
    assert decided(certain).memory.rungs.tolist() == [2, 2]
    for decision, failed in ((decided(doubtful), False), (decided(certain, error=np.nan), True)):
        assert decision.failed == failed
        assert decision.memory.rungs.tolist() == [0, 0]
