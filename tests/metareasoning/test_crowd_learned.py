"""The learned value of computation per human: what it looks at, what it chooses, and its file."""

from dataclasses import replace
from importlib import resources

import jax
import numpy as np
import pytest
from ms_highway.game.crowd_scenario import DENSE_MERGE, crowd_game, draw_crowd
from ms_highway.metareasoning.crowd.learned import LearnedCrowdValue
from ms_highway.metareasoning.crowd.rule import CrowdCosts, CrowdOutcome, first_crowd_memory
from ms_highway.metareasoning.crowd.situation import describe_humans, human_description_names
from ms_highway.metareasoning.crowd.values import CrowdValues, load_crowd_values, save_crowd_values
from ms_highway.planning.crowd import NAIVE, TOM, CrowdPlan

from ms_highway.game.planning_settings import PlanningSettings

HUMANS = 2
CROWD = crowd_game(DENSE_MERGE, HUMANS, planning=PlanningSettings(horizon=5))
START, _ = draw_crowd(DENSE_MERGE, HUMANS, np.random.default_rng(0), CROWD.game.human)
COSTS = CrowdCosts(0.003, np.array([0.0, 0.0006, 0.002], np.float32))
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


def test_values_are_read_as_they_were_written(tmp_path):
    rule, file = rule_with((0.5, 1.0)), tmp_path / "values.npz"
    save_crowd_values(
        CrowdValues(rule.network, rule.centre, rule.spread, human_description_names(), {"rounds": 2}), file
    )
    read = load_crowd_values(file)
    assert read.provenance == {"rounds": 2}
    same = jax.tree.map(np.array_equal, read.rule(COSTS, 0.0), rule)
    assert all(jax.tree.leaves(same))


def test_files_that_hold_something_else_or_only_a_part_are_refused(tmp_path):
    with pytest.raises(ValueError, match="kind 'of one human'"):
        load_crowd_values(resources.files("ms_highway") / "data" / "values.npz")
    rule, file = rule_with((0.5, 1.0)), tmp_path / "values.npz"
    save_crowd_values(CrowdValues(rule.network, rule.centre, rule.spread, human_description_names(), {}), file)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match="damaged or no values of crowds"):
        load_crowd_values(file)
    with pytest.raises(ValueError, match="shapes"):
        CrowdValues(rule.network[:0], rule.centre, rule.spread, human_description_names(), {})
