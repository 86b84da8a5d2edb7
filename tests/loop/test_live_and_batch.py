"""The one step of all robots does the same live and in batches, whatever drives, among one human and among three."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import jax
import numpy as np
import pytest
from driving import COSTS, LADDER, Brakes, drive, episodes_of, move, simulated
from jax import numpy as jnp

from ms_highway.choice.belief import RESPONDING
from ms_highway.choice.budget import Budget, OneStepGains
from ms_highway.choice.learned_value import load_values
from ms_highway.choice.quadratic import Switching, WholeHorizon
from ms_highway.choice.rule import Decision, Nearest, Order, Rule
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import swap_roles
from ms_highway.loop.batch import batch_parts
from ms_highway.loop.controller import FunctionDriver, always_yields, never_yields
from ms_highway.loop.driver import Driver
from ms_highway.loop.records import DECIDES, HUMAN_PLANS, Loop
from ms_highway.loop.step import STATUSES, begin
from ms_highway.loop.step import step as one_step
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import PredictedHuman
from ms_highway.planning.ladders import ladder


@dataclass(frozen=True)
class Failing(PredictedHuman):
    """A user-defined model whose prediction is not finite."""

    name: ClassVar[str] = "failing"

    def predict(self, game, state, start=None):
        return jnp.full((game.planner.horizon, 2), jnp.nan)


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
    costs = Costs.of(COSTS.each, humans)
    values = load_values("shipped", "several" if humans > 1 else "pair")
    one_step = OneStepGains(Switching(costs, 0.0, LADDER))
    return {
        "switching": Switching(costs, 0.1, LADDER),
        "whole horizon": WholeHorizon(costs, 0.1, LADDER),
        "learned": values.rule(LADDER, costs, 1.0),
        "budget": Budget(one_step, costs, seconds=0.6, deciding=0.01),
        "budget of values": Budget(values.rule(LADDER, costs, 0.0), costs, seconds=0.7, deciding=0.01),
        "nearest": Nearest(1, LADDER),
    }


@pytest.fixture(scope="module", params=[1, pytest.param(3, marks=pytest.mark.slow)])
def scene(request, played):
    """A game, and two starts; the number of humans is that of the game."""
    humans = request.param
    scenario = "merger" if humans == 1 else "dense_merge"
    games, starts = zip(*(played(scenario, seed, humans=humans) for seed in range(2)), strict=True)
    return games[0], np.array(starts)


def agree(records, episode, live, models):
    """Check states, models and statuses of one episode of a batch against a live drive."""
    states, driven = live
    np.testing.assert_allclose(records.states[episode], states[1:], atol=1e-3, rtol=0)
    assert [tuple(models[rung].name for rung in rungs) for rungs in records.rungs[episode]] == [
        step.models for step in driven
    ]
    assert [STATUSES[number] for number in records.status[episode]] == [step.status for step in driven]


@pytest.mark.slow
@pytest.mark.usefixtures("stopped_by_nans")
def test_rules_decide_alike_live_and_in_batches_and_differently_from_each_other(scene):
    game, starts = scene
    named, chosen = rules(game.number), set()
    for which, (name, rule) in enumerate(named.items()):
        records = simulated(Loop(game, OneOf(tuple(named.values()), np.int32(which), LADDER)), starts)
        chosen.add(records.rungs.tobytes())
        for episode, start in enumerate(starts):
            _, driven = live = drive(Driver(game, rule), start, 5)
            assert not any(step.choice_failed for step in driven), name
            agree(records, episode, live, LADDER)
            for gains, step in zip(records.gains[episode], driven, strict=True):
                known = np.isfinite(step.gains)
                np.testing.assert_allclose(gains[known], step.gains[known], atol=1e-2, err_msg=name)
    assert len(chosen) > 3


@pytest.mark.slow
def test_a_driver_with_a_budget_measures_the_time_of_its_decisions(scene):
    game, starts = scene
    rule = replace(rules(game.number)["budget"], seconds=10.0, deciding=0.0)
    driver = Driver(game, rule, budget=10.0)
    steps = [driver.step(starts[0]) for _ in range(2)]
    assert 0 < driver.rule.deciding < 1
    assert [step.status for step in steps] == ["planned"] * 2
    assert steps[0].models == ("naive",) * game.number
    first = game.number > 1  # with one human, no gain is told of the model in use
    assert np.isfinite(steps[1].gains).all(axis=0).tolist() == [first, False, True]
    again = Driver(game, rule, budget=10.0)
    assert again.step(starts[0]).compile_seconds > again.rule.deciding  # which compiles nothing, but measures again


def weaves(game, state):
    """Return a control that depends on the robot's position, and that steers more than tyres hold."""
    return keep_velocity(game.world, state[0]) + jnp.stack([jnp.float32(0.03), 0.1 * (state[1, 0] - state[0, 0])])


MODELS = (*ladder(["naive", "idm", "turn", "tom@3+warm"]), Brakes(2.0), Failing())
NAIVE, TOM, FAILING = 0, 3, 5  # among these
ALWAYS_TOM = [[TOM] * 3] * 9
MIXED = [[0, 2, 3], [1, 0, 0], [2, 3, 1], [3, 3, 3], [3, 1, 4], [4, 0, 2], [1, 4, 0], [3, 2, 2], [4, 3, 1]]
FAILS = [[rung] * 3 for rung in (NAIVE, *[FAILING] * 6, NAIVE, FAILING)]
DRIVERS = never_yields, always_yields, weaves
EPISODES = {  # number of the start, models of the humans in each step, and what drives the humans
    "planning humans": (0, ALWAYS_TOM, None),
    "never": (0, ALWAYS_TOM, never_yields),
    "always": (0, ALWAYS_TOM, always_yields),
    "way out": (1, ALWAYS_TOM, None),
    "weaving": (1, ALWAYS_TOM, weaves),
    "many models": (0, MIXED, None),  # plans start from the rest of the last one only if a model in use says so
    "failing plans": (0, FAILS, None),
    "no plan": (0, [[FAILING] * 3] * 9, None),
}


@pytest.mark.filterwarnings("ignore:human model 'failing' predicts:UserWarning")
def test_a_step_is_the_same_live_and_in_batches_whatever_drives_robot_and_humans(scene):
    game, starts = scene
    places, schedules, functions = zip(*EPISODES.values(), strict=True)
    schedules = np.array(schedules)[:, :, : game.number]
    drivers = [[1 + DRIVERS.index(function) if function else HUMAN_PLANS] * game.number for function in functions]
    loop = Loop(game, Order(schedules[0], MODELS), way_out=True, belief=True, drivers=DRIVERS)
    with pytest.warns(UserWarning, match="human model 'failing' predicts"):
        records = simulated(loop, starts[[*places]], 9, schedules, drivers)
    driven = {}
    for episode, name in enumerate(EPISODES):
        function = functions[episode]
        humans = function and [FunctionDriver(swap_roles(game, i), "own", function) for i in range(game.number)]
        driver = Driver(game, Order(schedules[episode], MODELS), way_out=True, belief=True)
        live = drive(driver, starts[places[episode]], 9, humans)
        agree(records, episode, live, MODELS)
        driven[name] = live[1]
    statuses = {step.status for steps in driven.values() for step in steps}
    assert statuses == {*STATUSES} - {"late"}
    assert "way out" in [step.status for step in driven["way out"]]
    assert {step.status for step in driven["no plan"]} == {"braking"}
    failing = [step.status for step in driven["failing plans"]]
    assert failing == ["planned", *["previous plan"] * 4, "braking", "braking", "planned", "previous plan"]
    for name in ("planning humans", "never", "always"):
        last = driven[name][-1]
        ignored = last.belief[:, RESPONDING].sum(axis=1) < 0.3
        assert ignored.any() == (name != "planning humans")
        assert {model for model, alone in zip(last.models, ignored, strict=True) if alone} <= {"naive"}


@pytest.mark.filterwarnings("ignore:human model 'failing' predicts:UserWarning")
def test_a_late_plan_is_followed_a_step_later_live_and_in_jax(scene):
    """Late are the first plan, two that follow each other, one that is not finite, and one after braking."""
    game, (state, _) = scene
    models = (*ladder(["naive+warm"]), Failing())
    late = [True, False, True, True, False, True, *[False] * 5, True, False]
    rungs = [0, 0, 0, 0, 0, 1, *[1] * 5, 0, 0]
    order = Order(np.repeat(np.array(rungs)[:, None], game.number, axis=1), models)
    driver = Driver(game, order)
    loop = Loop(game, order, chunk=1)
    own = jax.tree.map(lambda part: part[0], episodes_of(loop, state[None]))

    @partial(jax.jit, static_argnums=2)
    def in_jax(carry, now, is_late):
        scheduled = np.full(game.number, DECIDES)
        return one_step(carry, now, batch_parts(loop, own, scheduled)._replace(is_late=lambda: is_late))

    carry = begin(order, game, np.float32(state))
    statuses = []
    for is_late in late:
        driver.budget = 0.0 if is_late else None
        live = driver.step(state)
        carry, result = in_jax(carry, np.float32(state), is_late)
        steps = int(result.driven.steps) or None
        assert STATUSES[result.status] == live.status
        assert tuple(models[rung].name for rung in result.driven.rungs) == live.models
        controls = result.driven.plan.robot[:steps] * game.planner.control_scale
        np.testing.assert_allclose(controls, live.plan, atol=1e-4)
        statuses.append(live.status)
        keeps = np.asarray(keep_velocity(game.world, state[1 : 1 + game.number]))
        state = move(game, state, [live.control, *keeps])
    failed = ["previous plan"] * 4 + ["braking"] * 2
    assert statuses == ["late", "planned", "late", "late", "planned", *failed, "late", "planned"]
