"""Rules for several humans: who is important, what they gain together, and Algorithm 1 for each human alone."""

from dataclasses import dataclass, field, replace

import jax
import numpy as np
import pytest
from jax import numpy as jnp

from ms_highway.control.driver import Driver
from ms_highway.game.dynamics import keep_velocity
from ms_highway.metareasoning.budget import Budget, OneStepGains
from ms_highway.metareasoning.rankings import Barrier, Influence, Nearest, Risk, TimeToCollision
from ms_highway.metareasoning.rule import Decision, Outcome, decide, first_memory
from ms_highway.metareasoning.switching import Switching
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


@pytest.mark.parametrize(
    ("ranking", "first", "second"),
    [(Nearest, 0, 3), (TimeToCollision, 1, 2), (Influence, 0, 3), (Barrier, 1, 0)],
)
def test_theory_of_mind_is_for_the_most_important_humans(outcome, ranking, first, second):
    for count, important in [(0, []), (1, [first]), (2, [first, second]), (9, range(4))]:
        rungs = np.asarray(chosen(ranking(count, COSTS, RUNGS), *outcome).memory.rungs)
        np.testing.assert_array_equal(np.flatnonzero(rungs == TOM), sorted(important))
        assert (rungs[rungs != TOM] == NAIVE).all()


def test_a_human_that_speeds_away_constrains_the_robot_less(outcome):
    """By 4 m/s^2, so that it comes after the one who approaches from behind, beside the robot."""
    game, seen = outcome
    before = seen.before.copy()
    before[1, 3] -= 4.0 * float(game.world.time_step)
    for slower, second in [(seen.before, 0), (before, 2)]:
        rungs = chosen(Barrier(2, COSTS, RUNGS), game, seen._replace(before=slower)).memory.rungs
        np.testing.assert_array_equal(np.flatnonzero(rungs == TOM), sorted([1, second]))


def test_theory_of_mind_is_for_those_who_may_collide_within_the_plan_and_for_no_one_else(outcome):
    """In 2 s, the much slower car would be hit; within half a second, nobody."""
    game, seen = outcome
    longer = seen._replace(plan=Plan(*(np.concatenate([side] * 4, axis=-2) for side in seen.plan)))

    def important(count, threshold, seen):
        return np.flatnonzero(chosen(Risk(count, COSTS, RUNGS, threshold), game, seen).memory.rungs == TOM).tolist()

    assert important(9, 0.05, seen) == important(0, 0.05, longer) == []
    assert important(1, 0.05, longer) == important(9, 0.05, longer) == [1]
    assert important(2, 0.0, seen) == [0, 3]  # equal risks: the nearest first


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownGains:
    """Gains that are given."""

    gains: np.ndarray
    ladder: tuple = field(default=RUNGS, metadata={"static": True})

    def look(self, game, memory, outcome):
        return jnp.asarray(self.gains)

    def choose(self, memory, seen):
        return Decision(memory, seen, jnp.bool(False))


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
def test_gains_are_estimated_for_every_human_alone(outcome):
    game, seen = outcome
    decision = chosen(estimates(), game, seen)
    fewer_humans = among(game, np.asarray(game.humans.weights)[1:])
    order = np.array([0, 2, 3, 4, 1])  # the first human is a scripted car now
    fewer = seen._replace(
        before=seen.before[order],
        after=seen.after[order],
        humans=seen.humans[1:],
        plan=Plan(seen.plan.robot, seen.plan.humans[1:]),
    )
    expected = chosen(estimates(), fewer_humans, fewer)
    np.testing.assert_allclose(decision.gains[1:], expected.gains, atol=1e-4)
    assert np.isnan(decision.gains[:, TURN]).all()
    assert (decision.gains[:, NAIVE] == 0).all()
    first = chosen(estimates(), game, seen, step=0)
    assert np.isnan(first.gains).all()


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


@pytest.mark.slow
def test_a_top_rung_that_does_not_respond_gains_what_algorithm_1_says(played):
    game, state = played("merger")
    switching = Switching(Costs(0.0, np.zeros(2)), 0.0, RUNGS[:2])
    plan = Plan(jnp.full((5, 2), 0.1), jnp.full((1, 5, 2), 0.2))
    seen = Outcome(state, state, plan.robot[0], plan.humans[:, 0], jnp.float32(1.0), plan)
    gains = [float(chosen(rule, game, seen).gains[0, TURN]) for rule in (switching, OneStepGains(switching))]
    assert gains[0] == pytest.approx(gains[1], rel=1e-5)
