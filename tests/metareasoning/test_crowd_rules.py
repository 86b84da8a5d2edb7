"""Rules for several humans: who is important, what they gain together, and Algorithm 1 for each human alone."""

from dataclasses import dataclass

import jax
import numpy as np
import pytest
from jax import numpy as jnp
from ms_highway.control.crowd import CrowdDriver
from ms_highway.control.fixed import FixedModel
from ms_highway.control.switching import ModelSwitching
from ms_highway.game.crowd import Crowd
from ms_highway.metareasoning.crowd.baselines import AllOfOne, Influence, Nearest, RandomRungs, TimeToCollision
from ms_highway.metareasoning.crowd.budget import Budget
from ms_highway.metareasoning.crowd.compiled_decision import CompiledCrowdDecision, CrowdObservation
from ms_highway.metareasoning.crowd.rule import CrowdDecision, CrowdOutcome, first_crowd_memory
from ms_highway.metareasoning.crowd.switching import OneStepGains, crowd_switching
from ms_highway.planning.compiled_crowd import CrowdCosts
from ms_highway.planning.crowd import NAIVE, TOM, TURN, CrowdPlan

from ms_highway.envs import SCENARIOS
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.dynamics import step as move
from ms_highway.game.game import swap_roles
from ms_highway.metareasoning.switching import Switching
from ms_highway.planning.human_models import MODELS, PAPER_MODELS, ladder
from ms_highway.runtime.compilation import jit_quickly

COSTS = CrowdCosts(0.09, np.array([0.0, 0.08, 0.28]))  # s, of the paper's decisions
LANE = 100 / 30  # m

# in the robot's lane: 15 m ahead and as fast, 40 m ahead and much slower; beside it: 20 m behind and faster; far aside
HUMANS = [[15.0, 0.0, 0.0, 20.0], [40.0, 0.0, 0.0, 2.0], [-20.0, LANE, 0.0, 22.0], [12.0, 4 * LANE, 0.0, 5.0]]


@pytest.fixture(scope="session")
def outcome(played):
    """Four humans around a robot that follows a lane; nobody has moved yet."""
    game, _ = played("merger")
    state = np.array([[0.0, 0.0, 0.0, 20.0], *HUMANS], np.float32)
    crowd = Crowd(game, np.tile(game.human.weights, (4, 1)))
    kept = np.tile(keep_velocity(game.dynamics, state)[:, None] / game.planner.control_scale, (1, 5, 1))
    plan = CrowdPlan(kept[0], kept[1:])
    return crowd, CrowdOutcome(state, state, kept[0, 0], kept[1:, 0], np.float32(0), plan)


@jit_quickly
def choose(rule, crowd, memory, outcome):
    return rule.choose(crowd, memory, outcome)


def chosen(rule, crowd, outcome, step=1, seed=0):
    memory = first_crowd_memory(crowd.humans, seed)._replace(step=np.asarray(step, np.int32))
    return choose(rule, crowd, memory, outcome)


@pytest.mark.parametrize(("ranking", "first", "second"), [(Nearest, 0, 3), (TimeToCollision, 1, 2), (Influence, 0, 3)])
def test_theory_of_mind_is_for_the_most_important_humans(outcome, ranking, first, second):
    for count, important in [(0, []), (1, [first]), (2, [first, second]), (9, range(4))]:
        rungs = np.asarray(chosen(ranking(count), *outcome).memory.rungs)
        np.testing.assert_array_equal(np.flatnonzero(rungs == TOM), sorted(important))
        assert (rungs[rungs != TOM] == NAIVE).all()


def test_all_humans_may_have_the_same_model(outcome):
    decision = chosen(AllOfOne(TURN), *outcome)
    assert (np.asarray(decision.memory.rungs) == TURN).all()
    assert decision.memory.step == 2
    assert np.isnan(decision.gains).all()


def test_random_models_have_their_shares_and_follow_from_seed_and_step(outcome):
    rule = RandomRungs(np.array([0.7, 0.0, 0.3]))
    memory = first_crowd_memory(4)

    def draw(step, seed):
        return rule.choose(outcome[0], memory._replace(step=step, seed=seed), outcome[1]).memory.rungs

    drawn = np.asarray(jax.vmap(jax.vmap(draw, (0, None)), (None, 0))(jnp.arange(100), jnp.arange(20)))
    assert np.bincount(drawn.ravel(), minlength=3) / drawn.size == pytest.approx([0.7, 0.0, 0.3], abs=0.02)
    np.testing.assert_array_equal(drawn[3, 7], chosen(rule, *outcome, step=7, seed=3).memory.rungs)
    assert (drawn[0] != drawn[1]).any()
    assert (drawn[:, 0] != drawn[:, 1]).any()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KnownGains:
    """Gains that are given."""

    gains: np.ndarray

    def choose(self, crowd, memory, outcome):
        return CrowdDecision(memory, jnp.asarray(self.gains), jnp.bool(False))


def test_a_budget_is_spent_where_it_gains_most(outcome):
    gains = KnownGains(np.array([[0, 1, 3], [np.nan, 2, 2.5], [0, np.nan, 9], [0, -1, np.nan]], np.float32))
    costs = CrowdCosts(0.010, np.array([0.0, 0.002, 0.008]))

    def rungs(seconds, deciding=0.0):
        return chosen(Budget(gains, costs, seconds, 0.5, deciding), *outcome).memory.rungs.tolist()

    assert rungs(1.0) == [TOM, TOM, TOM, NAIVE]
    assert rungs(0.0561) == [TOM, TURN, TOM, NAIVE]  # 8 + 2 + 8 ms of 28 - 10
    assert rungs(0.0561, deciding=0.001) == [TURN, TURN, TOM, NAIVE]
    assert rungs(0.0242) == [TURN, NAIVE, NAIVE, NAIVE] or rungs(0.0242) == [NAIVE, TURN, NAIVE, NAIVE]
    assert rungs(0.001) == [NAIVE] * 4  # not even these fit


def episode(game, state, switching, steps=12):
    """The states and the robot's steps of a real episode with one human, under today's Algorithm 1."""
    robot, human = ModelSwitching(game, switching), FixedModel(swap_roles(game), MODELS["naive"])
    states, driven = [np.asarray(state, float)], []
    for _ in range(steps):
        now = states[-1]
        driven.append(robot.step(now))
        controls = [driven[-1].control, human.step(np.concatenate([now[1::-1], now[2:]])).control]
        states.append(move(game.world, now, np.concatenate([controls, keep_velocity(game.world, now[2:])])))
    return states, driven


@pytest.mark.parametrize(
    ("scenario", "price"),
    [("merger", 0.0), ("merger", 30.0), *(pytest.param(name, 1.0, marks=pytest.mark.slow) for name in SCENARIOS)],
)
def test_with_one_human_algorithm_1_decides_as_it_always_has(played, scenario, price):
    game, state = played(scenario)
    crowd, scale = Crowd(game, np.asarray(game.human.weights)[None]), np.asarray(game.planner.control_scale)
    usual = Switching(COSTS.base + COSTS.each, price, ladder(PAPER_MODELS))
    states, driven = episode(game, state, usual)
    decides, memory = CompiledCrowdDecision(crowd_switching(COSTS, price), crowd), first_crowd_memory(1)
    memory = decides.decide(memory, decides.nothing_happened(states[0]))[0].memory
    assert memory.rungs[0] == NAIVE
    models = set()
    for before, now, last, step in zip(states, states[1:], driven, driven[1:], strict=False):
        plan = CrowdPlan(last.plan / scale, last.human[None] / scale)
        decision, _ = decides.decide(memory, CrowdObservation(before, now, last.control / scale, plan))
        memory, gains = decision.memory, dict(zip(PAPER_MODELS, decision.gains[0], strict=True))
        assert PAPER_MODELS[memory.rungs[0]] == step.model
        assert [name for name, gain in gains.items() if np.isfinite(gain)] == list(step.gains)
        for name, gain in step.gains.items():
            assert gains[name] == pytest.approx(gain, rel=1e-3, abs=1e-3)
        models.add(step.model)
    assert len(models) > 1 or price > 0


def test_gains_are_estimated_for_every_human_alone(outcome):
    crowd, seen = outcome
    decision = chosen(OneStepGains(crowd_switching(COSTS, 0.0).switching), crowd, seen)
    alone = Crowd(crowd.game, np.asarray(crowd.weights)[1:])
    order = np.array([0, 2, 3, 4, 1])  # the first human is a scripted car now
    fewer = seen._replace(
        before=seen.before[order],
        after=seen.after[order],
        humans=seen.humans[1:],
        plan=CrowdPlan(seen.plan.robot, seen.plan.humans[1:]),
    )
    expected = chosen(OneStepGains(crowd_switching(COSTS, 0.0).switching), alone, fewer)
    np.testing.assert_allclose(decision.gains[1:], expected.gains, atol=1e-4)
    assert np.isnan(decision.gains[:, TURN]).all()
    assert (decision.gains[:, NAIVE] == 0).all()
    first = chosen(OneStepGains(crowd_switching(COSTS, 0.0).switching), crowd, seen, step=0)
    assert np.isnan(first.gains).all()


def test_a_driver_measures_the_time_of_decisions_within_a_budget(outcome):
    crowd, seen = outcome
    rule = Budget(OneStepGains(crowd_switching(COSTS, 0.0).switching), COSTS, 10.0)
    driver = CrowdDriver(crowd, rule, budget=10.0)
    steps = [driver.step(seen.after) for _ in range(2)]
    assert 0 < driver.rule.deciding < 1
    assert steps[0].rungs == ("naive",) * 4
    assert set(steps[1].gains) == {"naive", "tom"}
    assert {step.status for step in steps} == {"planned"}
