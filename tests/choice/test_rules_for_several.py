"""Rules for several humans.

`nearest` chooses by distance, learned values by gains, `budget` by those that fit.
"""

from dataclasses import dataclass, field, replace

import jax
import numpy as np
import pytest
from driving import LADDER
from jax import numpy as jnp

from ms_highway.choice.budget import Budget
from ms_highway.choice.choosers import Nearest
from ms_highway.choice.learned_value import load_values
from ms_highway.choice.rule import (
    NOT_ESTIMATED,
    Chooser,
    Estimate,
    Estimator,
    Rule,
    decide,
    decide_on,
    first_memory,
    refuse_rungs,
)
from ms_highway.loop.step import begin
from ms_highway.planning.costs import Costs
from ms_highway.runtime.compilation import jit_quickly

NAIVE, TURN, TOM = range(3)
COSTS = Costs(0.010, np.array([0.0, 0.002, 0.008]), ("naive", "turn", "tom"))

STATE = np.float32(
    [
        [0, 0, 0, 20],  # the robot
        [15, 0, 0, 20],  # in its lane, and as fast
        [90, 0, 0, 20],  # far ahead
        [40, 0, 0, 2],  # ahead, and slower
        [-20, 3.3, 0, 22],  # behind in the next lane
        [12, 13.3, 0, 5],  # far aside
    ]
)
NEAREST_FOUR = np.array([1, 0, 1, 1, 1])  # whether a human is among them

SHIPPED = load_values("shipped")
decide_quickly = jit_quickly(decide)


@pytest.fixture(scope="session")
def game(played):
    """A robot among five humans."""
    game, _ = played("merger")
    return replace(
        game, humans=replace(game.humans, weights=np.tile(game.humans.weights, (5, 1)))
    )


def decided(rule, game, error=0.0, before=0):
    """Return the decision after plans with these rungs; the error adds to the state."""
    memory, outcome, *_ = begin(rule, game, STATE + error)
    memory = memory._replace(rungs=np.int32(memory.rungs + before))
    return decide_quickly(rule, game, memory, outcome)


def chosen(rule, game):
    return decided(rule, game).memory.rungs.tolist()


def test_rules_of_different_classes_are_compiled_separately():
    """JAX takes such dataclasses for equal: `jax.jit` alone takes one in eight of these
    for an earlier one.
    """
    number = jit_quickly(lambda rule: rule.count * type(rule).number)
    for copy in range(40):
        kind = dataclass(frozen=True)(
            type(f"Rule{copy}", (), {"__annotations__": {"count": int}, "number": copy})
        )
        assert number(jax.tree_util.register_dataclass(kind)(1)) == copy


def test_theory_of_mind_predicts_the_nearest_humans(game):
    for count, rungs in (
        (0, [NAIVE] * 5),
        (2, [TOM, NAIVE, NAIVE, NAIVE, TOM]),
        (9, [TOM] * 5),
    ):
        assert chosen(Rule(LADDER, COSTS, Nearest(count)), game) == rungs


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownGains(Estimator):
    """An estimator with given gains."""

    gains: np.ndarray

    def estimate(self, memory, evidence):
        return Estimate(jnp.asarray(self.gains), jnp.bool(False))


def test_a_budget_is_spent_where_it_gains_most(game):
    none = NOT_ESTIMATED
    gains = KnownGains(
        np.float32([[0, 1, 3], [0, 0, -1], [none, 2, 2.5], [0, none, 9], [0, -1, none]])
    )
    for milliseconds, deciding, rungs in (
        (1000.0, 0.0, [TOM, NAIVE, TOM, TOM, NAIVE]),
        (56.1, 0.0, [TOM, NAIVE, TURN, TOM, NAIVE]),  # 8 + 2 + 8 ms fit into 28 - 10 ms
        (56.1, 0.001, [TURN, NAIVE, TURN, TOM, NAIVE]),
        (1.0, 0.0, [NAIVE] * 5),  # not even these fit
    ):
        budget = Budget(milliseconds, 0.5, deciding)
        assert chosen(Rule(LADDER, COSTS, budget, gains), game) == rungs


def over_naive(gains, price=0.0, doubt=0.0):
    """Return a rule whose networks expect the same gains everywhere.

    They are less certain about the gain of tom than about that of turn.
    """
    *hidden, (weights, biases) = SHIPPED.network
    expected = np.zeros_like(biases)
    expected[:, :2] = gains
    expected[:, 1] += doubt * np.resize([1, -1], len(biases))
    network = (*hidden, (0 * weights, expected))
    return with_networks(SHIPPED.rule(LADDER, COSTS, price), network=network)


def with_networks(rule, **changes):
    """Return a rule with other numbers of its estimator."""
    return replace(rule, estimator=replace(rule.estimator, **changes))


def test_a_budget_without_gains_goes_to_the_nearest_humans(game):
    nothing = with_networks(over_naive((0.0, 0.0)), margin=0.0, nearest=None)
    rule = replace(nothing, chooser=Budget(27.0, 1.0))
    assert chosen(rule, game) == [TOM, NAIVE, NAIVE, NAIVE, TOM]  # 2 x 8 ms fit


def test_higher_prices_choose_cheaper_models_by_the_same_gains(game):
    """They do so for the nearest four humans."""
    gains = np.where(NEAREST_FOUR[:, None], [0.0, 0.5, 1.0], NOT_ESTIMATED)
    for price, rung in ((0.0, TOM), (100.0, TURN), (1000.0, NAIVE)):
        before = [TURN, TOM, NAIVE, TOM, NAIVE]
        decision = decided(over_naive((0.5, 1.0), price), game, before=before)
        np.testing.assert_allclose(decision.gains, gains, atol=1e-6)
        assert decision.memory.rungs.tolist() == [*rung * NEAREST_FOUR]


def test_one_rung_predicts_the_nearest_humans_worth_most_together(game):
    """Turn gains the same for each human.

    Theory of mind gains 1 for the nearest human, and loses for every other one.
    """
    # The hidden layer passes on the share of humans who are nearer, small enough that
    # tanh is linear.
    nearer = np.zeros((1, len(SHIPPED.input_mean), 1), np.float32)
    nearer[0, -1] = 0.01
    hidden = nearer, np.zeros((1, 1), np.float32)
    as_they_are = {
        "input_mean": 0 * SHIPPED.input_mean,
        "input_std": 1 + 0 * SHIPPED.input_mean,
    }

    shipped = SHIPPED.rule(LADDER, COSTS, 0.0)
    for gain, rungs in ((0.4, TURN * NEAREST_FOUR), (0.2, [TOM, *[NAIVE] * 4])):
        weights = np.float32([[[0.0, -800.0, 0.0, 0.0]]])
        biases = np.float32([[gain, 1.0, 0.0, 0.0]])
        network = hidden, (weights, biases)
        rule = with_networks(shipped, network=network, **as_they_are)
        assert chosen(rule, game) == [*rungs]


def test_doubtful_and_failed_estimates_choose_the_cheapest_rung(game):
    certain = over_naive((0.0, 0.1))
    doubtful = over_naive((0.0, 0.1), doubt=1.0)
    assert chosen(certain, game) == [*TOM * NEAREST_FOUR]
    for decision, failed in (
        (decided(doubtful, game), False),
        (decided(certain, game, error=np.nan), True),
    ):
        assert decision.failed == failed
        assert decision.memory.rungs.tolist() == [NAIVE] * 5


def test_a_shorter_ladder_has_the_gains_of_the_whole(game):
    """With a single rung, nothing is left to choose."""

    def decided_on(size):
        costs = replace(COSTS.select(COSTS.names[:size]), base=0.0)
        return decided(SHIPPED.rule(LADDER[:size], costs, 10.0), game)

    whole, part, nothing = (decided_on(size) for size in (3, 2, 1))
    np.testing.assert_allclose(whole.gains[:, :2], part.gains, rtol=1e-4)
    assert nothing.memory.rungs.tolist() == [NAIVE] * 5


# What parts of a user's return


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Returns(Chooser):
    """A chooser that returns anything."""

    what: object = field(metadata={"static": True})

    def choose(self, memory, gains, costs, evidence):
        return jnp.asarray(self.what) if isinstance(self.what, tuple) else self.what


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Estimates(Estimator):
    """An estimator that returns anything, a tuple as an array."""

    gains: object = field(metadata={"static": True})
    failed: object = field(default=False, metadata={"static": True})

    def estimate(self, memory, evidence):
        gains = jnp.asarray(self.gains) if isinstance(self.gains, tuple) else self.gains
        failed = (
            jnp.asarray(self.failed) if isinstance(self.failed, tuple) else self.failed
        )
        return gains if gains is None else Estimate(gains, failed)


KNOWN = ((0.0, 1.0, NOT_ESTIMATED),) * 3
NAMED_RUNGS = "return one whole number for each human, 3 in all: 0 for naive"
NAMED_GAINS = r"return one for each human and rung, an array \(3, 3\)"
FLAG = "return one boolean for all humans"
WRONG = [
    (Returns(None), None, f"the rule Returns returned None; {NAMED_RUNGS}"),
    (Returns("naive"), None, f"the rule Returns returned 'naive'; {NAMED_RUNGS}"),
    (Returns(2**40), None, f"the rule Returns returned 1099511627776; {NAMED_RUNGS}"),
    (
        Returns((0.0, 1.0, 2.0)),
        None,
        f"the rule Returns returned (the rungs|float32) .*; {NAMED_RUNGS}",
    ),
    (
        Nearest(1),
        Estimates(None),
        r"the estimator Estimates returned None; return an Estimate\(gains, failed\)",
    ),
    (
        Nearest(1),
        Estimates("abc"),
        f"the estimator Estimates returned the gains 'abc'; {NAMED_GAINS}",
    ),
    (
        Nearest(1),
        Estimates(1j),
        f"the estimator Estimates returned the gains 1j; {NAMED_GAINS}",
    ),
    (
        Nearest(1),
        Estimates(1.0),
        rf"the estimator Estimates returned gains of shape \(\); {NAMED_GAINS}",
    ),
    (
        Nearest(1),
        Estimates(KNOWN, None),
        f"the estimator Estimates returned failed=None; {FLAG}",
    ),
    (
        Nearest(1),
        Estimates(KNOWN, 0),
        f"the estimator Estimates returned failed=0; {FLAG}",
    ),
    (
        Nearest(1),
        Estimates(KNOWN, (False,) * 3),
        f"the estimator Estimates returned failed=.*; {FLAG}",
    ),
    (
        Nearest(1),
        Estimates(((0.0, np.inf, 1.0),) * 3),
        "the estimator Estimates returned gains that are NaN or inf",
    ),
    (
        Nearest(1),
        Estimates(((0.0, np.nan, 1.0),) * 3),
        "the estimator Estimates returned gains that are NaN or inf",
    ),
]


@pytest.mark.parametrize(("chooser", "estimator", "message"), WRONG)
@pytest.mark.parametrize("traced", [False, True])
def test_what_no_part_may_return_is_refused(
    played, chooser, estimator, message, traced
):
    """The error has the name of the part, the value and a remedy."""
    game, state = played("dense_merge", humans=3)
    rule = Rule(LADDER, COSTS, chooser, estimator)
    memory, outcome, *_ = begin(rule, game, state)
    decided = jax.jit(decide) if traced else decide
    with pytest.raises(ValueError, match=message):
        refuse_rungs(rule, decided(rule, game, memory, outcome).memory.rungs)


def test_a_list_of_names_is_no_choice():
    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Names(Chooser):
        """A chooser that returns names instead of rungs."""

        def choose(self, memory, gains, costs, evidence):
            return ["naive"]

    rule = Rule(LADDER, COSTS, Names())
    with pytest.raises(
        ValueError,
        match=r"the rule Names returned \['naive'\]; return one whole number",
    ):
        decide_on(rule, first_memory(rule, 1), None)


def test_gains_that_are_known_or_not_estimated_are_taken(played):
    game, state = played("dense_merge", humans=3)
    rule = Rule(LADDER, COSTS, Nearest(1), Estimates(KNOWN))
    memory, outcome, *_ = begin(rule, game, state)
    decision = jax.jit(decide)(rule, game, memory, outcome)
    np.testing.assert_array_equal(decision.gains, KNOWN)
    assert not decision.failed
