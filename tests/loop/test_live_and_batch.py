"""Live drives agree with batches, with one human and with two: models, rules, beliefs, ways out."""

from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import jax
import numpy as np
import pytest
from driving import SCENES, drive, simulated
from jax import numpy as jnp

from ms_highway.choice.belief import RESPONDING
from ms_highway.choice.budget import Budget, OneStepGains
from ms_highway.choice.learned_value import load_values
from ms_highway.choice.quadratic import Switching, WholeHorizon
from ms_highway.choice.rule import Decision, Nearest, Order, Rule, unestimated
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import swap_roles
from ms_highway.loop.controller import FunctionDriver, always_yields, never_yields
from ms_highway.loop.driver import Driver, fixed
from ms_highway.loop.records import Loop
from ms_highway.loop.step import BRAKING, STATUSES, WAY_OUT
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import Naive, PredictedHuman, TheoryOfMind
from ms_highway.planning.ladders import ladder

STEPS, SEEDS = 5, 2
PAPERS = ladder(["naive", "turn", "tom"])


@dataclass(frozen=True)
class Timid(PredictedHuman):
    """A user-defined model: the human always brakes by 2 m/s^2."""

    name: ClassVar[str] = "timid"

    def predict(self, game, state, start=None):
        control = keep_velocity(game.dynamics, state[1]) - jnp.array([0.0, 2.0])
        return jnp.tile(control / game.planner.control_scale, (game.planner.horizon, 1))


@dataclass(frozen=True)
class Failing(PredictedHuman):
    """A user-defined model whose prediction is not finite."""

    name: ClassVar[str] = "failing"

    def predict(self, game, state, start=None):
        return jnp.full((game.planner.horizon, 2), jnp.nan)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ahead(Rule):
    """A user-defined rule: the top rung predicts humans ahead of the robot, the first rung all others."""

    distance: Any
    ladder: tuple = field(metadata={"static": True})

    def decide(self, game, memory, outcome):
        ahead = outcome.after[1 : 1 + game.number, 0] - outcome.after[0, 0]
        return unestimated(memory, jnp.where(ahead > self.distance, len(self.ladder) - 1, 0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OneOf(Rule):
    """Rules on the same ladder, one of which decides, so that batches of all take a single compilation."""

    rules: tuple
    which: Any
    ladder: tuple = field(metadata={"static": True})

    def decide(self, game, memory, outcome):
        def one(rule):
            after, gains, failed = rule.decide(game, memory, outcome)
            return Decision(jax.tree.map(jnp.int32, after), jnp.float32(gains), jnp.bool(failed))

        return jax.lax.switch(self.which, [partial(one, rule) for rule in self.rules])


def rules(humans):
    """All rules that choose models, by name."""
    costs = Costs.of([0.09, 0.17, 0.37], humans)
    values = load_values("shipped", "several" if humans > 1 else "pair")
    one_step = OneStepGains(Switching(costs, 0.0, PAPERS))
    return {
        "switching": Switching(costs, 0.1, PAPERS),
        "whole horizon": WholeHorizon(costs, 0.1, PAPERS),
        "learned": values.rule(PAPERS, costs, 1.0),
        "budget": Budget(one_step, costs, seconds=0.6, deciding=0.01),
        "budget of values": Budget(values.rule(PAPERS, costs, 0.0), costs, seconds=0.7, deciding=0.01),
        "nearest": Nearest(1, PAPERS),
    }


@pytest.fixture(scope="module", params=[1, pytest.param(2, marks=pytest.mark.slow)])
def scene(request, played):
    """A game, and starts; the number of humans is that of the game."""
    games, starts = zip(*(played(SCENES[request.param], seed) for seed in range(SEEDS)), strict=True)
    return games[0], np.array(starts)


@pytest.fixture(scope="module")
def records_of(scene):
    """The records of a batch under each rule; no rule may return NaN."""
    game, starts = scene
    named = rules(game.number)
    with jax.debug_nans(True):
        return {
            name: simulated(Loop(game, OneOf(tuple(named.values()), np.int32(which), PAPERS)), starts)
            for which, name in enumerate(named)
        }


def agree(records, episode, live, models):
    """Check states, models and statuses of one episode of a batch against a live drive."""
    states, driven = live
    np.testing.assert_allclose(records.states[episode], states[1:], atol=1e-3, rtol=0)
    assert [tuple(models[rung].name for rung in rungs) for rungs in records.rungs[episode]] == [
        step.models for step in driven
    ]
    assert [STATUSES[number] for number in records.status[episode]] == [step.status for step in driven]


@pytest.mark.slow
@pytest.mark.parametrize("humans", SCENES)
def test_models_and_efforts_on_schedules(played, humans):
    """Plans start from the rest of the last one only if a model in use says so."""
    game, start = played("merger", humans=humans)
    models = ladder(["naive", "idm", "turn", "tom@3+warm"])
    schedule = np.array([[0, 2], [1, 0], [2, 3], [3, 3], [3, 1]])[:, :humans]
    records = simulated(Loop(game, Order(schedule, models)), [start], schedule=schedule)
    agree(records, 0, drive(Driver(game, Order(schedule, models)), start, STEPS), models)


@pytest.mark.slow
@pytest.mark.usefixtures("stopped_by_nans")
@pytest.mark.parametrize("name", rules(1))
def test_rules(scene, records_of, name):
    game, starts = scene
    records = records_of[name]
    for episode, start in enumerate(starts):
        _, driven = live = drive(Driver(game, rules(game.number)[name]), start, STEPS)
        assert not any(step.choice_failed for step in driven)
        agree(records, episode, live, PAPERS)
        for gains, step in zip(records.gains[episode], driven, strict=True):
            known = np.isfinite(step.gains)
            np.testing.assert_allclose(gains[known], step.gains[known], atol=1e-2)


@pytest.mark.slow
def test_rules_decide_differently_here(records_of):
    assert len({records.rungs.tobytes() for records in records_of.values()}) > 3


def test_user_defined_rules_and_models(scene):
    game, starts = scene
    models = Naive(), TheoryOfMind(), Timid()
    rule = Ahead(np.float32(np.median(starts[:, 1 : 1 + game.number, 0] - starts[:, :1, 0])), models)
    records = simulated(Loop(game, rule), starts)
    assert set(records.rungs.ravel()) == {0, 2}
    for episode, start in enumerate(starts):
        agree(records, episode, drive(Driver(game, rule), start, STEPS), models)


@pytest.mark.filterwarnings("ignore:human model 'failing' predicts:UserWarning")
def test_plans_that_fail_beside_plans_that_do_not(played):
    game, start = played("merger")
    schedule, models = np.array([[0], *[[1]] * 6, [0], [1]]), (Naive(), Failing())
    schedules = [schedule, 0 * schedule, np.ones_like(schedule)]
    records = simulated(Loop(game, Order(schedule, models)), [start] * 3, 9, schedule=schedules)
    live = drive(Driver(game, Order(schedule, models)), start, 9)
    agree(records, 0, live, models)
    agree(records, 1, drive(fixed(game), start, 9), models)  # which the other episode leaves alone
    assert (records.status[2] == BRAKING).all()
    followed = [(step.status, *step.models) for step in live[1]]
    again, brakes = ("previous plan", "naive"), ("braking", "failing")
    assert followed == [("planned", "naive"), *[again] * 4, *[brakes] * 2, ("planned", "naive"), again]


def weaves(game, state):
    """Drive as a human whose control depends on the robot's place."""
    return keep_velocity(game.world, state[0]) + jnp.stack([jnp.float32(0.001), 0.1 * (state[1, 0] - state[0, 0])])


def test_beliefs_ways_out_and_drivers_of_humans(scene):
    game, starts = scene
    models, own = ladder(["naive", "tom+warm"]), (never_yields, always_yields, weaves)
    loop = Loop(game, Order(np.array([[1]]), models), way_out=True, belief=True, drivers=own)
    drivers = np.repeat([[0], [1], [2], [0], [3]], game.number, axis=1)
    records = simulated(loop, starts[[0, 0, 0, 1, 1]], 8, schedule=1, drivers=drivers)
    assert (records.status[3] == WAY_OUT).any()
    for episode, function in enumerate([None, never_yields, always_yields, None, weaves]):
        humans = function and [FunctionDriver(swap_roles(game, i), "own", function) for i in range(game.number)]
        driver = Driver(game, loop.rule, belief=True, way_out=True)
        live = drive(driver, starts[episode // 3], 8, humans=humans)
        agree(records, episode, live, models)
        ignored = live[1][-1].belief[:, RESPONDING].sum(axis=1) < 0.3
        if episode < 3:
            assert ignored.any() if humans else not ignored.any()
        assert {name for name, alone in zip(live[1][-1].models, ignored, strict=True) if alone} <= {"naive"}
