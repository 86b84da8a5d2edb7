"""Learned values of computation: what they look at, choose, and their files."""

import json
from dataclasses import replace

import gymnasium as gym
import jax
import numpy as np
import pytest

from ms_highway.choice.learned_value import LearnedValue
from ms_highway.choice.rule import PUBLISHED_COSTS, Outcome, decide, first_memory
from ms_highway.choice.situation import describe, description_names
from ms_highway.choice.values import load_values, save_values
from ms_highway.envs import SCENARIOS
from ms_highway.experiments.runner import make_environment
from ms_highway.game.scenario import PAPER_UNIT, build_game, draw_episode
from ms_highway.game.scenarios import DENSE_MERGE
from ms_highway.loop.driver import Driver
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import ladder
from ms_highway.planning.plans import Plan

describe_quickly = jax.jit(describe)
SHIPPED = load_values("shipped")
LADDER = ladder(("naive", "turn", "tom"))
COSTS = np.array([PUBLISHED_COSTS[model.name] for model in LADDER])
SEVERAL = Costs(0.003, np.array([0.0, 0.0006, 0.002], np.float32))  # s, over naive
INPUTS = description_names()
decide_quickly = jax.jit(decide)


def learned(price, **changes):
    return {"type": "learned", "lambda": price, **changes}


def models_of(config, scenario="merger", seed=0, **changes):
    env = make_environment(scenario, "naive", **changes)
    env.reset(seed=seed, options={"config": {"controller": config}})
    models, done = [], False
    while not done:
        *_, terminated, truncated, info = env.step(0)
        models.append(info["model"])
        done = terminated or truncated
    return models


@pytest.mark.parametrize("name", ["stay_back", "dense_merge"])
def test_a_description_does_not_know_units_or_places(name):
    scenario = SCENARIOS[name]
    small = build_game(scenario, unit=1.0)
    start, _ = draw_episode(scenario, np.random.default_rng(1), small.humans)
    start[:, 2] += 0.02
    described = describe_quickly(small, start)
    assert described.shape == (small.number, len(INPUTS))
    assert np.isfinite(described).all()
    metres = start * [PAPER_UNIT, PAPER_UNIT, 1, PAPER_UNIT]
    np.testing.assert_allclose(describe_quickly(build_game(scenario), metres), described, rtol=1e-3, atol=2e-3)
    game = build_game(scenario)
    moved = replace(game, scene=replace(game.scene, obstacles=game.scene.obstacles + np.array([50.0, 0.0])))
    further = describe_quickly(moved, metres + np.array([50.0, 0, 0, 0]))
    np.testing.assert_allclose(further, described, rtol=1e-2, atol=2e-2)  # float32 loses digits further out


def test_it_chooses_from_the_first_step_on_and_thinks_where_it_pays():
    models = models_of(learned(1.0))
    assert models[0] == "tom"  # where Algorithm 1 starts with naive
    assert models[-1] == "naive"
    assert 2 <= models.count("tom") <= 20


@pytest.mark.parametrize(("scenario", "price"), [("merger", 10.0), ("stay_back", 1.0)])
def test_the_highest_gain_that_is_told_is_the_model_that_plans(scenario, price):
    env, before, seen = make_environment(scenario, f"learned:{price}"), "naive", set()
    env.reset(seed=0)
    for _ in range(20):
        *_, info = env.step(0)
        gains = {before: 0.0} | info["gains"]
        assert max(gains, key=gains.get) == info["model"]
        seen.add(before := info["model"])
    assert len(seen) > 1 or scenario == "stay_back"


def test_values_that_are_not_finite_are_not_chosen_by_and_info_says_so():
    env = make_environment("merger", "learned:1")
    env.reset(seed=0)
    robot = env.unwrapped.robot
    rule = robot.controller.rule
    robot.controller = Driver(robot.controller.game, replace(rule, spread=np.full_like(rule.spread, np.nan)))
    *_, info = env.step(0)
    assert info["choice_failed"]
    assert info["model"] == "naive"
    assert info["gains"] == {}
    env.reset(seed=0)
    *_, info = env.step(0)
    assert not info["choice_failed"]
    assert set(info["gains"]) == {"turn", "tom"}  # over naive, the rung to begin with


def test_a_file_is_read_as_it_was_written(tmp_path):
    file = tmp_path / "values.npz"
    save_values(SHIPPED, file)
    read = load_values(file)
    for one, other in zip(jax.tree.leaves(read.network), jax.tree.leaves(SHIPPED.network), strict=True):
        np.testing.assert_array_equal(one, other)
    assert read.provenance == SHIPPED.provenance
    assert models_of(learned(1.0, values=str(file))) == models_of(learned(1.0))


def test_values_of_another_ladder_are_refused_with_the_remedy():
    with pytest.raises(ValueError, match="on the ladder naive turn tom, over 'naive'; begin the ladder with it"):
        gym.make("ms-highway/merger-v0", config={"controller": learned(1.0), "ladder": ["turn", "tom"]})
    part = SHIPPED.rule(LADDER[::2], Costs(0.0, COSTS[::2]), 1.0)
    assert [model.name for model in part.ladder] == ["naive", "tom"]


def test_a_part_of_the_ladder_weighs_rewards_as_the_whole_ladder_does(played):
    game, state = played("merger")
    whole, part = (SHIPPED.rule(LADDER[:size], Costs(0.0, COSTS[:size]), 10.0) for size in (3, 2))
    still = np.zeros((1, 5, 2), np.float32)
    outcome = Outcome(state, state, still[0, 0], still[:, 0], 0.0, Plan(still[0], still))
    rules = [replace(rule, cautious=False) for rule in (whole, part)]
    gains = [float(decide_quickly(rule, game, first_memory(rule, 1), outcome).gains[0, 1]) for rule in rules]
    assert gains[0] == pytest.approx(gains[1], rel=1e-4)  # of turn over naive


@pytest.fixture
def file(tmp_path):
    save_values(SHIPPED, tmp_path / "values.npz")
    return tmp_path / "values.npz"


def refused(file, problem=""):
    with pytest.raises(ValueError, match=rf"values\.npz cannot be read.*{problem}.*`ms-highway values learn` --out"):
        make_environment("merger", f"learned:1:{file}")


def about(**changes):
    return lambda told: np.array(json.dumps(json.loads(str(told)) | changes))


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        ("about", about(version=99), "version 99"),
        ("about", about(inputs=["speed"]), "another version"),
        ("about", about(ladder=["naive", "naive", "tom"]), "each once"),
        ("weights_2", lambda weights: weights * 1e9, "weights of the networks are beyond 1000"),
        ("about", lambda told: np.array("[" * 100_000), "recursion"),
        ("centre", lambda centre: centre * np.nan, "beyond 1e"),
        ("biases_2", lambda biases: biases.astype(object), "[Pp]ickle|allow_pickle"),
        ("biases_1", lambda biases: biases[:1], "shapes"),
    ],
)
def test_a_file_of_values_that_says_or_holds_wrong_things_is_refused_by_them(file, name, change, problem):
    with np.load(file) as archive:
        arrays = dict(archive)
    np.savez(file, **arrays | {name: change(arrays[name])})
    refused(file, problem)


def over_naive(gains, price=0.0):
    """A rule whose networks expect the same gains of turn and tom everywhere."""
    expected = np.zeros((2, 4), np.float32) + np.array([*gains, 0, 0], np.float32)
    network = ((np.zeros((2, len(INPUTS), 4), np.float32), expected),)
    standard = np.zeros(len(INPUTS), np.float32), np.ones(len(INPUTS), np.float32)
    return LearnedValue(SEVERAL, price, network, *standard, LADDER)


@pytest.fixture(scope="module")
def two():
    """A game with two humans, and a start."""
    game = build_game(DENSE_MERGE, humans=2)
    return game, draw_episode(DENSE_MERGE, np.random.default_rng(0), game.humans)[0]


def chosen(rule, game, state):
    still = np.zeros((10, 2), np.float32)
    outcome = Outcome(state, state, still[0], still[:2], 0.0, Plan(still, np.stack([still] * 2)))
    return decide_quickly(rule, game, first_memory(rule, 2), outcome)


def test_surroundings_describe_every_human_by_finite_numbers_and_change_places_with_the_humans(two):
    game, state = two
    described = describe_quickly(game, state)
    assert described.shape == (2, len(INPUTS))
    assert np.isfinite(described).all()
    assert not np.array_equal(described[0], described[1])
    np.testing.assert_allclose(describe_quickly(game, state[[0, 2, 1]])[::-1], described, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("price", "rung"), [(0.0, "tom"), (500.0, "turn"), (5000.0, "naive")])
def test_over_the_cheapest_rung_dearer_planning_chooses_cheaper_models(two, price, rung):
    rule = over_naive((0.5, 1.0), price)
    decision, expected = chosen(rule, *two), chosen(replace(rule, cautious=False), *two)
    np.testing.assert_allclose(decision.gains, [np.array([0.0, 0.5, 1.0]) - price * SEVERAL.each] * 2, atol=1e-6)
    np.testing.assert_allclose(expected.gains, [[0.0, 0.5, 1.0]] * 2, atol=1e-6)
    assert decision.memory.rungs.tolist() == [("naive", "turn", "tom").index(rung)] * 2
    assert not decision.failed


def test_over_the_cheapest_rung_doubts_and_failed_estimates_choose_it(two):
    game, state = two
    rule = over_naive((0.0, 0.1))
    ((weights, biases),) = rule.network
    apart = replace(rule, network=((weights, biases + np.array([[0, 1, 0, 0], [0, -1, 0, 0]], np.float32)),))
    assert chosen(rule, game, state).memory.rungs.tolist() == [2, 2]
    assert chosen(apart, game, state).memory.rungs.tolist() == [0, 0]
    failed = chosen(rule, game, np.full_like(state, np.nan))
    assert failed.failed
    assert failed.memory.rungs.tolist() == [0, 0]
