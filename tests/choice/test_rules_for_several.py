"""Rules for several humans: `nearest` chooses by distance, `budget` by the gains that fit into a time."""

from dataclasses import dataclass, field, replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.choice.budget import Budget, OneStepGains
from ms_highway.choice.learned_value import LearnedValue
from ms_highway.choice.quadratic import Switching
from ms_highway.choice.rule import Decision, Nearest, Outcome, Rule, decide, first_memory
from ms_highway.choice.situation import description_names
from ms_highway.loop.driver import Driver
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.ladders import ladder
from ms_highway.planning.plans import Plan
from ms_highway.runtime.compilation import jit_quickly

RUNGS = ladder(("naive", "turn", "tom"))
NAIVE, TURN, TOM = range(3)
LANE = 100 / 30  # m

# in the robot's lane: 15 m ahead and as fast, 40 m ahead and slower; in the next one: 20 m behind; far aside
HUMANS = [[15.0, 0.0, 0.0, 20.0], [40.0, 0.0, 0.0, 2.0], [-20.0, LANE, 0.0, 22.0], [12.0, 4 * LANE, 0.0, 5.0]]
STATE = np.array([[0.0, 0.0, 0.0, 20.0], *HUMANS], np.float32)

decide_quickly = jit_quickly(decide)


@pytest.fixture(scope="session")
def game(played):
    """A robot among four humans."""
    game, _ = played("merger")
    return replace(game, humans=replace(game.humans, weights=np.tile(game.humans.weights, (4, 1))))


def chosen(rule, game):
    still = np.zeros((5, 5, 2), np.float32)
    outcome = Outcome(STATE, STATE, still[0, 0], still[1:, 0], np.float32(0), Plan(still[0], still[1:]))
    return decide_quickly(rule, game, first_memory(rule, 4), outcome).memory.rungs.tolist()


def test_rules_of_different_classes_with_the_same_fields_are_compiled_separately():
    """JAX takes such dataclasses for equal: `jax.jit` alone takes one in eight of these for an earlier one."""
    number = jit_quickly(lambda rule: rule.count * type(rule).number)
    for copy in range(60):
        kind = dataclass(frozen=True)(type(f"Rule{copy}", (), {"__annotations__": {"count": int}, "number": copy}))
        assert number(jax.tree_util.register_dataclass(kind)(1)) == copy


@pytest.mark.parametrize(("count", "nearest"), [(0, []), (2, [0, 3]), (9, range(4))])
def test_theory_of_mind_predicts_the_nearest_humans(game, count, nearest):
    expected = [TOM if human in nearest else NAIVE for human in range(4)]
    assert chosen(Nearest(count, RUNGS), game) == expected


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownGains(Rule):
    """A rule with given gains."""

    gains: np.ndarray
    ladder: tuple = field(default=RUNGS, metadata={"static": True})

    def decide(self, game, memory, outcome):
        return Decision(memory, jnp.asarray(self.gains), jnp.bool(False))


def test_a_budget_is_spent_where_it_gains_most(game):
    gains = KnownGains(np.array([[0, 1, 3], [np.nan, 2, 2.5], [0, np.nan, 9], [0, -1, np.nan]], np.float32))
    costs = Costs(0.010, np.array([0.0, 0.002, 0.008]))
    for seconds, deciding, rungs in (
        (1.0, 0.0, [TOM, TOM, TOM, NAIVE]),
        (0.0561, 0.0, [TOM, TURN, TOM, NAIVE]),  # 8 + 2 + 8 ms fit into 28 - 10 ms
        (0.0561, 0.001, [TURN, TURN, TOM, NAIVE]),
        (0.001, 0.0, [NAIVE] * 4),  # not even these fit
    ):
        assert chosen(Budget(gains, costs, seconds, 0.5, deciding), game) == rungs


def test_a_budget_without_expected_gains_is_spent_on_the_nearest_humans(game):
    costs = Costs(0.010, np.array([0.0, 0.002, 0.008]))
    inputs = len(description_names())
    network = ((np.zeros((1, inputs, 4), np.float32), np.zeros((1, 4), np.float32)),)  # no gains
    gains = LearnedValue(costs, 0.0, network, np.zeros(inputs), np.ones(inputs), RUNGS, cautious=False)
    assert chosen(Budget(gains, costs, 0.027, 1.0), game) == [TOM, NAIVE, NAIVE, TOM]  # 2 x 8 ms fit


@pytest.mark.slow
def test_a_driver_with_a_budget_measures_the_time_of_its_decisions(game):
    costs = Costs(0.09, np.array([0.0, 0.08, 0.28]))
    rule = Budget(OneStepGains(Switching(costs, 0.0, RUNGS)), costs, 10.0)
    driver = Driver(game, rule, budget=10.0)
    steps = [driver.step(STATE) for _ in range(2)]
    assert 0 < driver.rule.deciding < 1
    assert steps[0].models == ("naive",) * 4
    assert np.isfinite(steps[1].gains).all(axis=0).tolist() == [True, False, True]
    assert {step.status for step in steps} == {"planned"}
    again = Driver(game, rule, budget=10.0)
    assert again.step(STATE).compile_seconds > again.rule.deciding  # which compiles nothing, but measures again
