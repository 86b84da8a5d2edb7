"""The one step of all robots does the same live and in batches.

It does so whatever drives, among one human and among three.
"""

from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, ClassVar

import jax
import numpy as np
import pytest
from driving import (
    COSTS,
    LADDER,
    Brakes,
    Brief,
    Eager,
    drive,
    episodes_of,
    move,
    simulated,
)
from jax import numpy as jnp

from ms_highway.choice.belief import RESPONDING
from ms_highway.choice.budget import Budget
from ms_highway.choice.learned_value import load_values
from ms_highway.choice.rule import (
    Chooser,
    Estimate,
    Estimator,
    Rule,
    Start,
    always,
    at_price,
    decide,
    in_order,
)
from ms_highway.envs.controllers import ModelOrder, Outside
from ms_highway.envs.registry import CONTROLLERS, controller_settings
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import swap_roles
from ms_highway.loop.batch import batch_parts
from ms_highway.loop.controller import FunctionDriver
from ms_highway.loop.driver import Driver, prepared_rule
from ms_highway.loop.records import DECIDES, HUMAN_PLANS, Loop
from ms_highway.loop.step import STATUSES, begin
from ms_highway.loop.step import step as one_step
from ms_highway.loop.yielding import always_yields, never_yields
from ms_highway.planning.costs import UNKNOWN, Costs
from ms_highway.planning.human_models import PredictedHuman
from ms_highway.planning.ladders import ladder
from ms_highway.runtime.compilation import jit_quickly

decide_quickly = jit_quickly(decide)


@dataclass(frozen=True)
class Failing(PredictedHuman):
    """A user-defined model whose prediction is not finite."""

    name: ClassVar[str] = "failing"

    def predict(self, game, state, start=None):
        return jnp.full((game.planner.horizon, 2), jnp.nan)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OneEstimator(Estimator):
    """Estimators, one of which estimates.

    Drives and batches of all of them take a single compilation each.
    """

    parts: tuple
    which: Any

    def estimate(self, memory, evidence):
        def one(part):
            gains, failed = part.estimate(memory, evidence)
            return Estimate(jnp.float32(gains), jnp.bool(failed))

        return jax.lax.switch(self.which, [partial(one, part) for part in self.parts])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OneChooser(Chooser):
    """Choosers, one of which chooses."""

    parts: tuple
    which: Any

    def choose(self, memory, gains, costs, evidence):
        choices = [
            partial(part.choose, memory, gains, costs, evidence) for part in self.parts
        ]
        return jax.lax.switch(
            self.which,
            [lambda choice=choice: jnp.int32(choice()) for choice in choices],
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OwnGains(Estimator):
    """A user's estimator, which knows the gain of the top rung only."""

    def estimate(self, memory, evidence):
        after = evidence.outcome.after
        humans = 1 + evidence.game.number
        distances = jnp.linalg.norm(after[1:humans, :2] - after[0, :2], axis=1)
        gains = jnp.full(memory.last_check.shape, -jnp.inf)
        return Estimate(gains.at[:, -1].set(0.15 * jnp.exp(-distances / 10.0)), False)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OwnChoice(Chooser):
    """A user's chooser, which changes the rung in every step."""

    def choose(self, memory, gains, costs, evidence):
        return (memory.rungs + 1) % gains.shape[1]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AtOnce(OwnChoice):
    """The same, without a compilation."""

    computes = False


@pytest.mark.parametrize("chooser", [OwnChoice(), AtOnce()])
def test_the_same_model_predicts_unresponsive_humans_live_and_in_batches(
    played, chooser
):
    game, _ = played("merger")
    models = ladder(["idm", "turn", "tom"])
    rule = Rule(models, UNKNOWN.select(model.name for model in models), chooser)
    _, live = prepared_rule(rule, belief=True)
    assert Loop(game, rule, belief=True).unresponsive == live == 0
    order, live = prepared_rule(in_order(np.array([[1]]), models), belief=True)
    assert Loop(game, order, belief=True).unresponsive == live == 3
    with pytest.raises(
        ValueError,
        match="with a belief, the models of the loop are tom; add naive to `others`",
    ):
        _ = Loop(game, always(models[2]), belief=True).unresponsive


def parts(humans):
    """Return all choosers and all estimators, by class and by name.

    Those of the package are as an episode has them.
    """
    start = Start(
        LADDER,
        Costs.of(COSTS.seconds, humans),
        "paper",
        humans,
        5,
        np.random.default_rng(0),
    )
    choosers = {}
    estimators = {}
    for name in (
        "switching:0.1",
        "horizon:0.1",
        "learned:1",
        "budget:700",
        "nearest:1",
    ):
        settings = controller_settings(name)
        rule = settings.rule(start)
        choosers[type(rule.chooser)] = rule.chooser
        if rule.estimator:
            estimators[settings.type] = rule.estimator
    return {**choosers, OwnChoice: OwnChoice()}, {**estimators, "own": OwnGains()}


def test_the_parts_of_all_controllers_are_tested():
    choosers, estimators = parts(1)
    for name, pair in CONTROLLERS.items():
        if issubclass(pair.chooser_class, (ModelOrder, Outside)):
            continue
        assert pair.chooser_class in choosers
        assert pair.estimator is None or name in estimators


@pytest.fixture(scope="module", params=[1, pytest.param(3, marks=pytest.mark.slow)])
def scene(request, played):
    """A game, and two starts; the number of humans is that of the game."""
    humans = request.param
    scenario = "merger" if humans == 1 else "dense_merge"
    games, starts = zip(
        *(played(scenario, seed, humans=humans) for seed in range(2)), strict=True
    )
    return games[0], np.array(starts)


def agree(records, episode, live, models):
    """Check an episode of a batch against a live drive: states, models, statuses."""
    states, driven = live
    np.testing.assert_allclose(records.states[episode], states[1:], atol=1e-3, rtol=0)
    assert [
        tuple(models[rung].name for rung in rungs) for rungs in records.rungs[episode]
    ] == [step.models for step in driven]
    assert [STATUSES[number] for number in records.status[episode]] == [
        step.status for step in driven
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("stopped_by_nans")
@pytest.mark.parametrize("humans", [1, 3])
def test_every_chooser_decides_alike_live_and_in_batches(played, humans):
    """It does so by every estimator.

    Gains do not depend on the chooser either, where the same rungs are in use; the
    first rung gains 0.
    """
    scenario = "merger" if humans == 1 else "dense_merge"
    seeds = range(2 if humans == 1 else 1)
    drawn = [played(scenario, seed, humans=humans) for seed in seeds]
    game, _ = drawn[0]
    starts = np.array([start for _, start in drawn])
    choosers, estimators = (tuple(each.values()) for each in parts(humans))
    costs = Costs.of(COSTS.seconds, humans)
    chosen = set()
    for chooser, estimator in product(range(len(choosers)), range(len(estimators))):
        made = (
            OneChooser(choosers, np.int32(chooser)),
            OneEstimator(estimators, np.int32(estimator)),
        )
        rule = Rule(LADDER, costs, *made)
        records = simulated(Loop(game, rule), starts)
        chosen.add(records.rungs.tobytes())
        for episode, start in enumerate(starts):
            _, driven = live = drive(Driver(game, rule), start, 5)
            name = type(choosers[chooser]), [*parts(humans)[1]][estimator]
            assert not any(step.choice_failed for step in driven), name
            agree(records, episode, live, LADDER)
            for gains, step in zip(records.gains[episode], driven, strict=True):
                known = np.isfinite(step.gains)
                np.testing.assert_array_equal(np.isfinite(gains), known, err_msg=name)
                np.testing.assert_allclose(
                    gains[known], step.gains[known], atol=1e-2, err_msg=name
                )
                assert (step.gains[known[:, 0], 0] == 0).all()
    assert len(chosen) > 8


@pytest.mark.parametrize(
    "name", ["switching:0.1", "horizon:0.1", "learned:1", "budget:700"]
)
def test_gains_depend_neither_on_the_price_nor_on_the_costs(scene, name):
    game, starts = scene
    humans = game.number
    start = Start(
        LADDER,
        Costs.of(COSTS.seconds, humans),
        "paper",
        humans,
        5,
        np.random.default_rng(0),
    )
    rule = controller_settings(name).rule(start)
    memory, outcome, *_ = begin(rule, game, starts[0])
    memory = memory._replace(step=np.int32(1))
    dear = at_price(
        replace(rule, costs=replace(rule.costs, base=0.0, each=100 * COSTS.each)),
        np.float32(3.0),
    )
    found = [decide_quickly(each, game, memory, outcome) for each in (rule, dear)]
    np.testing.assert_array_equal(found[0].gains, found[1].gains)
    assert (np.asarray(found[0].gains)[:, 0] == 0).all()
    assert np.isfinite(found[0].gains[:, -1]).all()


@pytest.mark.slow
def test_a_driver_with_a_budget_measures_its_decisions(scene):
    game, starts = scene
    humans = game.number
    values = load_values("shipped", "several" if humans > 1 else "pair").estimator(
        LADDER
    )
    rule = Rule(LADDER, Costs.of(COSTS.seconds, humans), Budget(10_000.0), values)
    driver = Driver(game, rule, budget=10.0)
    steps = [driver.step(starts[0]) for _ in range(2)]
    assert 0 < driver.rule.chooser.deciding < 1
    assert [step.status for step in steps] == ["planned"] * 2
    assert np.isfinite(steps[1].gains).all()
    again = Driver(game, rule, budget=10.0)
    first = again.step(starts[0])
    # The second driver compiles nothing, but measures again.
    assert first.compile_seconds > again.rule.chooser.deciding


def weaves(game, state):
    """Return a control that steers more than tyres hold.

    It depends on the robot's position.
    """
    return keep_velocity(game.world, state[0]) + jnp.stack(
        [jnp.float32(0.03), 0.1 * (state[1, 0] - state[0, 0])]
    )


MODELS = (
    *ladder(["naive", "idm", "turn", "tom@3+warm"]),
    Brakes(2.0),
    Failing(),
    Brief(),
    Eager(),
)
NAIVE, TOM, FAILING = 0, 3, 5  # among these
ALWAYS_TOM = [[TOM] * 3] * 9
MIXED = [
    [0, 2, 3],
    [1, 6, 0],
    [2, 3, 1],
    [6, 3, 7],
    [7, 1, 4],
    [4, 0, 2],
    [1, 7, 6],
    [3, 2, 2],
    [7, 6, 3],
]
FAILS = [[rung] * 3 for rung in (NAIVE, *[FAILING] * 6, NAIVE, FAILING)]
DRIVERS = never_yields, always_yields, weaves
# number of the start, models of the humans in each step, and what drives the humans
EPISODES = {
    "planning humans": (0, ALWAYS_TOM, None),
    "never": (0, ALWAYS_TOM, never_yields),
    "always": (0, ALWAYS_TOM, always_yields),
    "way out": (1, ALWAYS_TOM, None),
    "weaving": (1, ALWAYS_TOM, weaves),
    # Plans start from the rest of the last one only if a model in use says so.
    "many models": (0, MIXED, None),
    "failing plans": (0, FAILS, None),
    "no plan": (0, [[FAILING] * 3] * 9, None),
}


@pytest.mark.filterwarnings("ignore:human model 'failing' predicts:UserWarning")
def test_a_step_is_the_same_live_and_in_batches(scene):
    """It is, whatever drives robot and humans."""
    game, starts = scene
    places, schedules, functions = zip(*EPISODES.values(), strict=True)
    schedules = np.array(schedules)[:, :, : game.number]
    drivers = [
        [1 + DRIVERS.index(function) if function else HUMAN_PLANS] * game.number
        for function in functions
    ]
    loop = Loop(
        game, in_order(schedules[0], MODELS), way_out=True, belief=True, drivers=DRIVERS
    )
    with pytest.warns(UserWarning, match="human model 'failing' predicts"):
        records = simulated(loop, starts[[*places]], 9, schedules, drivers)
    driven = {}
    for episode, name in enumerate(EPISODES):
        function = functions[episode]
        humans = function and [
            FunctionDriver(swap_roles(game, i), "own", function)
            for i in range(game.number)
        ]
        driver = Driver(
            game, in_order(schedules[episode], MODELS), way_out=True, belief=True
        )
        live = drive(driver, starts[places[episode]], 9, humans)
        agree(records, episode, live, MODELS)
        driven[name] = live[1]
    statuses = {step.status for steps in driven.values() for step in steps}
    assert statuses == {*STATUSES} - {"late"}
    assert "way out" in [step.status for step in driven["way out"]]
    assert {step.status for step in driven["no plan"]} == {"braking"}
    failing = [step.status for step in driven["failing plans"]]
    assert failing == [
        "planned",
        *["previous plan"] * 4,
        "braking",
        "braking",
        "planned",
        "previous plan",
    ]
    for name in ("planning humans", "never", "always"):
        last = driven[name][-1]
        ignored = last.belief[:, RESPONDING].sum(axis=1) < 0.3
        assert not ignored.all() if name == "planning humans" else ignored.any()
        assert {
            model for model, alone in zip(last.models, ignored, strict=True) if alone
        } <= {"naive"}


@pytest.mark.filterwarnings("ignore:human model 'failing' predicts:UserWarning")
def test_a_late_plan_is_followed_a_step_later(scene):
    """So are two plans that follow each other, and one after braking.

    A late plan that is not finite is not followed.
    """
    game, (state, _) = scene
    models = (*ladder(["naive+warm"]), Failing())
    late = [True, False, True, True, False, True, *[False] * 5, True, False]
    rungs = [0, 0, 0, 0, 0, 1, *[1] * 5, 0, 0]
    order = in_order(np.repeat(np.array(rungs)[:, None], game.number, axis=1), models)
    driver = Driver(game, order)
    loop = Loop(game, order, chunk=1)
    own = jax.tree.map(lambda part: part[0], episodes_of(loop, state[None]))

    @partial(jax.jit, static_argnums=2)
    def in_jax(carry, now, is_late):
        scheduled = np.full(game.number, DECIDES)
        return one_step(
            carry,
            now,
            batch_parts(loop, own, scheduled)._replace(is_late=lambda: is_late),
        )

    carry = begin(order, game, np.float32(state))
    statuses = []
    for is_late in late:
        driver.budget = 0.0 if is_late else None
        live = driver.step(state)
        carry, result = in_jax(carry, np.float32(state), is_late)
        steps = int(result.executed.controls_left) or None
        assert STATUSES[result.status] == live.status
        assert tuple(models[rung].name for rung in result.executed.rungs) == live.models
        controls = result.executed.plan.robot[:steps] * game.planner.control_scale
        np.testing.assert_allclose(controls, live.plan, atol=1e-4)
        statuses.append(live.status)
        keeps = np.asarray(keep_velocity(game.world, state[1 : 1 + game.number]))
        state = move(game, state, [live.control, *keeps])
    failed = ["previous plan"] * 4 + ["braking"] * 2
    assert statuses == [
        "late",
        "planned",
        "late",
        "late",
        "planned",
        *failed,
        "late",
        "planned",
    ]
