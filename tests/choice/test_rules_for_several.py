"""Rules for several humans: who is important, what they gain together, and Algorithm 1 for each human alone."""

from dataclasses import dataclass, field, replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.choice.budget import Budget, OneStepGains
from ms_highway.choice.nearest import Nearest
from ms_highway.choice.quadratic import Switching
from ms_highway.choice.rule import Decision, Outcome, Rule, decide, first_memory
from ms_highway.game.dynamics import keep_velocity
from ms_highway.loop.driver import Driver
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import ladder
from ms_highway.planning.plans import Plan
from ms_highway.runtime.compilation import jit_quickly

RUNGS = ladder(("naive", "turn", "tom"))
NAIVE, TURN, TOM = range(3)
COSTS = Costs(0.09, np.array([0.0, 0.08, 0.28]))  # s, of the paper's decisions
LANE = 100 / 30  # m

# in the robot's lane: 15 m ahead and as fast, 40 m ahead and much slower; beside it: 20 m behind and faster; far aside
HUMANS = [[15.0, 0.0, 0.0, 20.0], [40.0, 0.0, 0.0, 2.0], [-20.0, LANE, 0.0, 22.0], [12.0, 4 * LANE, 0.0, 5.0]]


def among(game, weights):
    return replace(game, humans=replace(game.humans, weights=weights))


@pytest.fixture(scope="session")
def outcome(played):
    """Four humans around a robot that follows a lane; nobody has moved yet."""
    game, _ = played("merger")
    state = np.array([[0.0, 0.0, 0.0, 20.0], *HUMANS], np.float32)
    game = among(game, np.tile(game.humans.weights, (4, 1)))
    kept = np.tile(keep_velocity(game.dynamics, state)[:, None] / game.planner.control_scale, (1, 5, 1))
    plan = Plan(kept[0], kept[1:])
    return game, Outcome(state, state, kept[0, 0], kept[1:, 0], np.float32(0), plan)


@jit_quickly
def choose(rule, game, memory, outcome):
    return decide(rule, game, memory, outcome)


def chosen(rule, game, outcome, step=1):
    memory = first_memory(rule, game.number)._replace(step=np.asarray(step, np.int32))
    return choose(rule, game, memory, outcome)


def test_rules_with_the_same_fields_are_not_taken_for_each_other():
    """JAX holds such dataclasses for equal: `jax.jit` alone takes about one in eight of these for an earlier one."""
    number = jit_quickly(lambda rule: rule.count * type(rule).number)
    for copy in range(60):
        kind = dataclass(frozen=True)(type(f"Rule{copy}", (), {"__annotations__": {"count": int}, "number": copy}))
        assert number(jax.tree_util.register_dataclass(kind)(1)) == copy


@pytest.mark.parametrize(("count", "nearest"), [(0, []), (1, [0]), (2, [0, 3]), (3, [0, 2, 3]), (9, range(4))])
def test_theory_of_mind_is_for_the_nearest_humans(outcome, count, nearest):
    rungs = np.asarray(chosen(Nearest(count, RUNGS), *outcome).memory.rungs)
    np.testing.assert_array_equal(np.flatnonzero(rungs == TOM), nearest)
    assert (rungs[rungs != TOM] == NAIVE).all()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownGains(Rule):
    """Gains that are given."""

    gains: np.ndarray
    ladder: tuple = field(default=RUNGS, metadata={"static": True})

    def decide(self, game, memory, outcome):
        return Decision(memory, jnp.asarray(self.gains), jnp.bool(False))


def test_a_budget_is_spent_where_it_gains_most(outcome):
    gains = KnownGains(np.array([[0, 1, 3], [np.nan, 2, 2.5], [0, np.nan, 9], [0, -1, np.nan]], np.float32))
    costs = Costs(0.010, np.array([0.0, 0.002, 0.008]))

    def rungs(seconds, deciding=0.0):
        return chosen(Budget(gains, costs, seconds, 0.5, deciding), *outcome).memory.rungs.tolist()

    assert rungs(1.0) == [TOM, TOM, TOM, NAIVE]
    assert rungs(0.0561) == [TOM, TURN, TOM, NAIVE]  # 8 + 2 + 8 ms of 28 - 10
    assert rungs(0.0561, deciding=0.001) == [TURN, TURN, TOM, NAIVE]
    assert rungs(0.0242) == [TURN, NAIVE, NAIVE, NAIVE] or rungs(0.0242) == [NAIVE, TURN, NAIVE, NAIVE]
    assert rungs(0.001) == [NAIVE] * 4  # not even these fit


def estimates():
    return OneStepGains(Switching(COSTS, 0.0, RUNGS))


@pytest.mark.slow
def test_a_driver_measures_the_time_of_decisions_within_a_budget(outcome):
    game, seen = outcome
    driver = Driver(game, Budget(estimates(), COSTS, 10.0), budget=10.0)
    steps = [driver.step(seen.after) for _ in range(2)]
    assert 0 < driver.rule.deciding < 1
    assert steps[0].models == ("naive",) * 4
    assert np.isfinite(steps[1].gains).all(axis=0).tolist() == [True, False, True]
    assert {step.status for step in steps} == {"planned"}
    again = Driver(game, Budget(estimates(), COSTS, 10.0), budget=10.0)
    assert again.step(seen.after).compile_seconds > again.rule.deciding  # compiles nothing, and measures again
