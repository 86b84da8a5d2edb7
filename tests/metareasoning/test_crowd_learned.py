"""The learned value of computation per human: what it looks at, what it chooses, how it is learned, and its file."""

from dataclasses import replace
from functools import partial
from itertools import islice

import jax
import numpy as np
import pytest

from ms_highway.experiments.values.crowd import CrowdCourse, CrowdLearning, learn_crowd
from ms_highway.game.crowd_scenario import DENSE_MERGE, crowd_game, draw_crowd
from ms_highway.game.planning_settings import PlanningSettings
from ms_highway.metareasoning.crowd.learned import LearnedCrowdValue
from ms_highway.metareasoning.crowd.rule import CrowdCosts, CrowdOutcome, first_crowd_memory
from ms_highway.metareasoning.crowd.situation import describe_humans, human_description_names
from ms_highway.metareasoning.crowd.values import load_crowd_values, save_crowd_values
from ms_highway.planning.crowd import NAIVE, TOM, CrowdPlan
from ms_highway.simulation.devices import device_mesh, use_devices

HUMANS = 2
CROWD = crowd_game(DENSE_MERGE, HUMANS, planning=PlanningSettings(horizon=5))
START, _ = draw_crowd(DENSE_MERGE, HUMANS, np.random.default_rng(0), CROWD.game.human)
COSTS = CrowdCosts(0.003, np.array([0.0, 0.0006, 0.002], np.float32))
COURSE = CrowdCourse("dense_merge", CROWD, partial(draw_crowd, DENSE_MERGE, HUMANS, driver=CROWD.game.human), 6)
LEARNING = CrowdLearning(COSTS, rounds=2, states=6, horizon=5, seed=1)
INPUTS = len(human_description_names())
describe_quickly = jax.jit(describe_humans)


def rule_with(gains, price=0.0):
    """A rule whose networks expect the same gains of turn and tom everywhere."""
    expected = np.zeros((2, 4), np.float32) + np.array([*gains, 0, 0], np.float32)
    network = ((np.zeros((2, INPUTS, 4), np.float32), expected),)
    return LearnedCrowdValue(COSTS, price, network, np.zeros(INPUTS, np.float32), np.ones(INPUTS, np.float32))


@jax.jit
def choose(rule, state):
    still = np.zeros((5, 2), np.float32)
    plan = CrowdPlan(still, np.stack([still] * HUMANS))
    return rule.choose(CROWD, first_crowd_memory(HUMANS), CrowdOutcome(state, state, still[0], still[:2], 0.0, plan))


def test_every_human_is_described_by_finite_numbers_that_have_names():
    described = describe_quickly(CROWD, START)
    assert described.shape == (HUMANS, INPUTS)
    assert np.isfinite(described).all()
    assert not np.array_equal(described[0], described[1])


def test_descriptions_change_places_with_the_humans():
    swapped = describe_quickly(CROWD, START[[0, 2, 1]])
    np.testing.assert_allclose(swapped[::-1], describe_quickly(CROWD, START), rtol=1e-4, atol=1e-4)


def test_gains_are_over_a_naive_prediction():
    decision = choose(rule_with((0.5, 1.0)), START)
    np.testing.assert_allclose(decision.gains, np.tile([0.0, 0.5, 1.0], (HUMANS, 1)), atol=1e-6)


@pytest.mark.parametrize(("price", "rung"), [(0.0, "tom"), (500.0, "turn"), (5000.0, "naive")])
def test_the_dearer_planning_is_the_cheaper_are_the_models(price, rung):
    decision = choose(rule_with((0.5, 1.0), price), START)
    assert decision.memory.rungs.tolist() == [("naive", "turn", "tom").index(rung)] * HUMANS
    assert decision.memory.step == 1
    assert not decision.failed


def test_in_doubt_and_without_finite_estimates_a_human_is_predicted_naively():
    rule = rule_with((0.0, 0.1))
    ((weights, biases),) = rule.network
    apart = replace(rule, network=((weights, biases + np.array([[0, 1, 0, 0], [0, -1, 0, 0]], np.float32)),))
    assert choose(rule, START).memory.rungs.tolist() == [TOM, TOM]
    assert choose(apart, START).memory.rungs.tolist() == [NAIVE, NAIVE]
    failed = choose(rule, np.full_like(START, np.nan))
    assert failed.failed
    assert failed.memory.rungs.tolist() == [NAIVE, NAIVE]


def same(one, other):
    pairs = zip(jax.tree.leaves(one.network), jax.tree.leaves(other.network), strict=True)
    return all(np.array_equal(first, second) for first, second in pairs)


@pytest.fixture(scope="module")
def learned():
    return list(learn_crowd(LEARNING, [COURSE], None, device_mesh(jax.local_devices()[:1])))


def test_each_round_ends_in_values_of_all_examples_so_far(learned):
    assert [(step.round, step.course) for step in learned] == [(1, "dense_merge"), (1, ""), (2, "dense_merge"), (2, "")]
    assert [step.values.provenance["examples"] for step in learned[1::2]] == [12, 24]  # two humans in each state


def test_learning_goes_on_where_it_was_killed_and_gives_the_same_values_on_any_devices(learned, tmp_path):
    kept = tmp_path / "kept.npz"
    list(islice(learn_crowd(LEARNING, [COURSE], kept, use_devices()), 1))
    *_, last = learn_crowd(LEARNING, [COURSE], kept, use_devices())
    assert same(last.values, learned[-1].values)
    with pytest.raises(ValueError, match="other settings"):
        next(learn_crowd(replace(LEARNING, seed=2), [COURSE], kept, use_devices()))


def test_values_are_read_as_they_were_written(learned, tmp_path):
    file = tmp_path / "values.npz"
    save_crowd_values(learned[-1].values, file)
    read = load_crowd_values(file)
    assert same(read, learned[-1].values)
    assert read.provenance["rounds"] == 2
    with pytest.raises(ValueError, match="damaged or no values of crowds"):
        load_crowd_values(_damaged(file))


def _damaged(file):
    file.write_bytes(file.read_bytes()[:100])
    return file
